"""A disk that is full while `learn` writes: what was rendered stays, and the same call goes on."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from fide_plugins.cli import main
from fide_plugins.learning import Model
from tests.learning.conftest import SIDE

resource = pytest.importorskip("resource")  # not on Windows


def same(one: Model, other: Model) -> bool:
    """Whether two models are, bit for bit."""
    states = one.network.state_dict(), other.network.state_dict()
    return one.report.curve == other.report.curve and all(
        torch.equal(states[0][name], states[1][name]) for name in states[0] | states[1]
    )


SCENE = f"""
import os
import resource
import numpy as np

space, renders = 2, 0


def render(x):
    global renders
    renders += 1
    if renders == 250 and os.path.exists("full"):  # no file may grow further, as by a quota
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    return np.outer(np.linspace(0, x[0], {SIDE}), np.linspace(0, x[1], {SIDE}))
"""


def test_the_command_says_how_to_go_on(
    empty_folder: Path, forked_command: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("scene.py").write_text(SCENE)
    Path("full").touch()
    words = ("scene.py:render", "--size", SIDE, "--out", "m.fide", "--passes", 1)
    command = forked_command("learn", *words, "--renders", 300)
    with command.stderr:
        said = command.stderr.read()
    Path("full").unlink()  # before anything is rendered in this process
    assert os.waitstatus_to_exitcode(os.waitpid(command.pid, 0)[1]) == 1
    assert "000002.npz: File too large; make room, or name another" in said
    assert "what was rendered and learned is kept in m.fide.renders\nwhen that is mended, " in said
    assert "Traceback" not in said and "Exception ignored" not in said
    assert set(os.listdir("m.fide.renders")) == {
        ".learn.lock", "000000.npz", "000001.npz", "settings"
    }  # fmt: skip

    again = shlex.split(said.rpartition("continue with: ")[2])
    assert again[-1] == "--resume" and main(again[1:]) == 0
    assert "renders 300/300" in capsys.readouterr().err
    assert main([str(word) for word in ("learn", *words, "--renders", 300, "--out", "n.fide")]) == 0
    assert same(Model.load("m.fide"), Model.load("n.fide"))
