"""`fide learn` as a user meets it."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fide_plugins.cli import main
from fide_plugins.learning import Model

SCENE = """
import numpy as np
from fide_plugins import Float, Space

space = Space(left=Float(0, 1), right=Float(0, 1))


def render(params):
    return np.repeat(np.linspace(params["left"], params["right"], 16)[None], 16, axis=0)
"""


pytestmark = pytest.mark.usefixtures("empty_folder")


def fide(*words: object) -> int:
    return main([str(word) for word in words])


def test_a_function_is_learned_and_the_model_is_used(capsys: pytest.CaptureFixture[str]) -> None:
    Path("gradient.py").write_text(SCENE)
    words = ("learn", "gradient.py:render", "--size", 16, "--out", "m.fide", "--passes", 2)
    assert fide(*words, "--renders", 100) == 0
    captured = capsys.readouterr()
    assert "pass 2/2  held-out renders:" in captured.err
    assert re.search("nats (better|worse) than the uniform prior", captured.out)  # so few renders
    assert Model.load("m.fide").report.renders == 98
    assert fide(*words, "--renders", 200) == 2
    assert "is there already; add --resume" in capsys.readouterr().err
    assert fide(*words, "--renders", 200, "--resume") == 0
    assert Model.load("m.fide").report.renders == 196

    run = ("run", "gradient.py:render", "--budget", 60, "--json", "--out", "r")
    capsys.readouterr()
    assert fide(*run, "--learned", "m.fide") == 0
    assert json.loads(capsys.readouterr().out)["best_loss"] < 0.01


def test_a_task_is_learned(capsys: pytest.CaptureFixture[str]) -> None:
    scene = ("learn", "voronoi", "--task-set", "cells=2", "--size", 16, "--passes", 1)
    words = (*scene, "--render-size", 32, "--renders", 100, "--out", "v.fide")
    assert fide(*words) == 0
    assert "emulator, pass 1/1  held-out renders:" in capsys.readouterr().err
    model = Model.load("v.fide")
    assert (model.shape, model.size) == ((32, 32), (16, 16))
    assert model.emulator is not None
    assert model.blocks == ((0, 1, 2, 3, 4), (5, 6, 7, 8, 9))
    assert fide("run", "voronoi", "--task-set", "cells=3", "--learned", "v.fide") == 2
    assert "has 10 parameters, and the optimizer 15" in capsys.readouterr().err
    assert fide(*words, "--resume", "--no-emulator") == 0
    assert Model.load("v.fide").emulator is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "name either a SOURCE or a --command"),
        (("nothing",), "no task is named 'nothing'"),
        (("voronoi", "--space", "s.toml"), "s.toml"),
        (("--command", "true {out}"), "needs --space"),
        (("voronoi", "--time", "soon"), "time must be a positive number"),
        (("voronoi", "--timeout", "5"), "--timeout is of --command; leave it out"),
        (("gradient.py:render", "--timeout", "5"), "--timeout is of --command; leave it out"),
        (("gradient.py:render", "--render-size", "32"), "--render-size is of built-in tasks"),
    ],
)
def test_wrong_usage_is_one_line(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide("learn", *words, "--out", "m.fide") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_keeps_what_is_there_and_resume_goes_on(
    signum: signal.Signals, forked_command: Callable[..., Any]
) -> None:
    Path("gradient.py").write_text(SCENE)
    words = ("gradient.py:render", "--size", 16, "--out", "m.fide", "--renders", 300, "--passes")
    command = forked_command("learn", *words, 100_000)
    while not (line := command.stderr.readline()).startswith("pass "):
        assert line, "it has ended"
    code, errors = command.stop(signum)
    assert code == 128 + signum
    assert f"stopped by {signum.name}; what was rendered and learned is kept" in errors
    assert "--resume" in errors and "Traceback" not in errors
    assert {path.name for path in Path("m.fide.renders").iterdir()} == {
        *(".learn.lock", "settings", "training", "000000.npz", "000001.npz", "000002.npz")
    }
    assert fide("learn", *words, 1, "--resume") == 0
