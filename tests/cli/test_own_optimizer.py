"""A user's optimizer in `fide run` and `fide compare`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fide_plugins.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_optimizer.py"


@pytest.fixture(autouse=True)
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """``mine.py`` in the current folder, which imports its neighbor."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "search.py").write_text(EXAMPLE.read_text())
    (tmp_path / "mine.py").write_text("from search import Elitist\n\n\nclass Mine(Elitist): ...\n")
    return tmp_path


def fide(*words: object) -> int:
    return main([str(word) for word in words])


SMALL = ("--budget", 40, "--size", 16, "--task-set", "cells=2")


def test_run_keeps_its_name_and_resumes(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "voronoi", *SMALL, "--optimizer", "mine.py:Mine", "--out", "out", "--json"]
    assert fide(*words, "--set", "step=0.1") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["optimizer"], result["evaluations"]) == ("mine.py:Mine", 40)
    assert fide(*words, "--set", "step=0.1", "--resume") == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["best_loss"] == result["best_loss"]


@pytest.mark.parametrize("command", ["run", "compare"])
def test_errors_come_before_any_render(
    command: str, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (mine / "scene.py").write_text("space = 2\ndef render(x):\n    raise SystemExit('rendered')\n")
    (mine / "deaf.py").write_text(
        "class Deaf:\n    def __init__(self, dim): ...\n    def ask(self, n): ...\n"
    )
    flag = "--optimizer" if command == "run" else "--optimizers"
    assert fide(command, "scene.py:render", flag, "deaf.py:Deaf", "--out", "out") == 2
    error = capsys.readouterr().err
    assert "deaf.py:Deaf has no method tell; give it tell(X, losses)" in error
    assert error.count("\n") == 1 and not Path("out").exists()
