"""The command line as a user meets it: output, exit codes, messages."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import fide_plugins
import fide_tasks
from fide_plugins.cli import main
from fide_plugins.cli.terminal import note, plain
from fide_plugins.fide import FIDE
from fide_plugins.options import PRESETS
from fide_plugins.runtime.machine import EXTRAS

from .conftest import KEYS, fide, one_line

SMALL = ["--optimizer", "cma", "--size", "24"]
pytestmark = pytest.mark.usefixtures("empty_folder")


def test_json_is_the_last_line_of_standard_output_with_these_keys(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        fide("run", "voronoi", *SMALL, "--budget", 40, "--seed", 3, "--task-seed", 2, "--json") == 0
    )
    captured = capsys.readouterr()
    result = json.loads(captured.out.splitlines()[-1])
    assert list(result) == KEYS
    assert result["task"] == "voronoi" and result["optimizer"] == "cma" and result["loss"] == "mse"
    assert (result["seed"], result["task_seed"], result["dim"]) == (3, 2, 40)
    assert result["budget"] == result["evaluations"] == 40
    assert result["best_loss"] == result["mse"] > 0
    assert len(result["x_best"]) == 40 and all(0 <= x <= 1 for x in result["x_best"])
    assert result["wall_s"] == pytest.approx(result["render_s"] + result["overhead_s"])
    assert "40/40" in captured.err and "render" in captured.err


@pytest.mark.figures
def test_a_run_without_json_says_where_to_look(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("run", "spline", *SMALL, "--loss", "perceptual", "--budget", 20) == 0
    out = capsys.readouterr().out
    assert "best perceptual" in out and "MSE" in out and "after 20 renders" in out
    assert "look at runs/spline-cma-perceptual-seed0/summary.png" in out
    assert Path("runs/spline-cma-perceptual-seed0/summary.png").is_file()


def test_options_reach_the_optimizer_and_the_task(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--set", "popsize=7", "--set", "sigma0=0.25", "--set", "restarts=ipop"]
    words += ["--task-set", "cells=2", "--out", "r"]
    assert fide("run", "voronoi", *SMALL, "--budget", 15, *words) == 0
    settings = json.loads(Path("r/run.json").read_text())["settings"]
    assert settings["options"] == {"popsize": 7, "sigma0": 0.25, "restarts": "ipop"}
    assert settings["task_options"] == {"cells": 2} and settings["dim"] == 10


def test_the_help_names_every_preset(capsys: pytest.CaptureFixture[str]) -> None:
    """It is no list made of `PRESETS`, since the parser is there before NumPy is imported."""
    for command in ("run", "fit"):
        assert fide(command, "--help") == 0
        assert ", ".join(PRESETS) in " ".join(capsys.readouterr().out.split())
    assert fide("tradeoff", "--help") == 0
    assert ",".join(PRESETS) in capsys.readouterr().out
    assert all(f'"{name}"' in str(FIDE.__doc__) for name in PRESETS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "nothing"], "no task is named 'nothing'; the tasks: .*spline, .*voronoi"),
        (["run", "voronoi", *SMALL, "--set", "popsize"], "key=value, not 'popsize'"),
        (["run", "voronoi", *SMALL, "--set", "seed=1"], "seed is an argument of the run"),
        (["run", "voronoi", *SMALL, "--budget", "0"], "--budget: a whole number >= 1, not '0'"),
        (["run", "voronoi", *SMALL, "--out", ""], "--out: a path, not an empty text"),
        (
            ["run", "voronoi", "--size", "99999999"],
            "not enough memory .*PiB.*; use smaller images",
        ),
        (["run"], "name a TASK, or give --command"),
        (["fit", "none.png"], "--renderer --command --model is required"),
        (["fit", "a.png", "--model", "spline", "--cells", "3"], "--cells belongs to --model voron"),
        (["dance"], "invalid choice: 'dance'"),
        (["mcp", "now"], "unrecognized arguments: now"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    line = one_line(capsys)
    assert re.search(message, line), line
    assert not Path("runs").exists()


def test_another_run_s_directory_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "voronoi", *SMALL, "--budget", "5", "--out", "r"]
    assert main(words) == 0
    capsys.readouterr()
    assert main([*words, "--seed", "1", "--resume"]) == 2
    assert "other settings: seed is 0 there and 1 here" in one_line(capsys)
    assert main(words) == 2
    assert "already holds a run" in one_line(capsys)


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("--version") == 0
    assert capsys.readouterr().out == f"fide {fide_plugins.__version__}\n"
    for words in (["--help"], ["run", "--help"], ["fit", "-h"], ["list", "-h"], ["doctor", "-h"]):
        assert main(words) == 0
        assert "usage: fide" in capsys.readouterr().out
    assert main([]) == 2
    assert "fide doctor" in capsys.readouterr().err


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    expected = {
        "tasks": {"spline", "voronoi"},
        "optimizers": {"cma", "fide", "random"},
        "encoders": {"dense", "patch"},
        "losses": {"loi", "mse", "perceptual"},
    }
    for kind, names in expected.items():
        assert fide("list", kind) == 0
        lines = capsys.readouterr().out.splitlines()
        assert names <= set(lines)
        assert kind == "tasks" or lines == sorted(lines)


def test_list_says_what_is_missing(no_weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, name, needs in [
        ("encoders", "vgg19", "no weights of VGG-19 at"),
        ("losses", "lpips", "no weights of AlexNet at"),
    ]:
        assert fide("list", kind) == 0
        (line,) = (x for x in capsys.readouterr().out.splitlines() if x.split()[0] == name)
        assert re.match(rf"{name} +not here: {needs} .*download=True", line)


def test_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("doctor", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    for kind, name in [("tasks", "voronoi"), ("optimizers", "cma"), ("losses", "mse")]:
        assert facts[kind][name] is None
    assert facts["extras"].keys() == EXTRAS.keys()
    assert fide("doctor") == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["dense", "ok"] in lines and ["mse", "ok"] in lines and ["encoders"] in lines


# -- interruption ----------------------------------------------------------------------------------


def test_a_run_that_fails_is_exit_code_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from fide_tasks.voronoi import Voronoi

    def broken(*_: object) -> None:
        raise MemoryError("no more")

    monkeypatch.setattr(Voronoi, "_render", broken)

    target = np.zeros((8, 8, 3))
    task = fide_tasks.make("voronoi", target=target)
    monkeypatch.setattr(fide_tasks, "make", lambda *a, **k: task)
    assert fide("run", "voronoi", *SMALL, "--budget", 5) == 1
    err = capsys.readouterr().err
    assert "the run failed: voronoi failed to render candidates 0 to 4" in err
    assert "Traceback" not in err


# -- text ------------------------------------------------------------------------------------------


def test_a_reader_that_has_gone_stops_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as nobody:
        monkeypatch.setattr(sys, "stderr", nobody)
        for _ in range(3):
            note("best 0.1")


def test_text_cannot_control_the_terminal() -> None:
    assert plain("a\x1b[31m b\n\tc\u202e") == "a\\x1b[31m b c\\u202e"
