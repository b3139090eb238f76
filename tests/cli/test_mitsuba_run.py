"""``fide run`` on a task with noise and fidelity."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fide_plugins.cli import main

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")

WORDS = ["run", "beads", "--optimizer", "cma", "--size", "16", "--budget", "8", "--json"]
WORDS += ["--task-set", "reference_spp=16"]


def test_spp_has_a_flag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "a")
    assert main([*WORDS, "--spp", "2", "--out", out]) == 0
    printed = capsys.readouterr()
    first = json.loads(printed.out.splitlines()[-1])
    run = json.loads((tmp_path / "a" / "run.json").read_text())
    assert run["settings"]["task_options"] == {"reference_spp": 16, "spp": 2}
    assert run["totals"]["mse"] == run["totals"]["reference_loss"] != first["best_loss"]
    assert (tmp_path / "a" / "reference.png").exists()
