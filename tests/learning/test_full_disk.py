"""A disk that is full while `learn` writes: what was rendered stays, and the same call goes on."""

from __future__ import annotations

import errno
import os
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.cli import main
from fide_plugins.learning import Model, learn, renders as store
from fide_plugins.runtime import checkpoint, files
from fide_plugins.types import Float64
from tests.learning.conftest import SIDE

resource = pytest.importorskip("resource")  # not on Windows
ARGUMENTS: dict[str, Any] = {"renders": 300, "size": SIDE, "passes": 2}


def gradient(x: Float64) -> Float64:
    return np.outer(np.linspace(0, x[0], SIDE), np.linspace(0, x[1], SIDE))


class Limited:
    """A file that holds so many bytes, the last ones of a disk."""

    def __init__(self, file: Any, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: Any) -> int:
        piece = bytes(data)[: self._room]
        self._room -= self._file.write(piece)
        if len(piece) < len(bytes(data)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return len(piece)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def fill_the_disk(patch: pytest.MonkeyPatch, module: Any, name: str, room: int) -> None:
    """From now on the disk has room for so many bytes of a file of that name."""

    @contextmanager
    def writer(path: Any) -> Iterator[Any]:
        with files.atomic_writer(path) as file:
            yield Limited(file, room) if Path(path).name == name else file

    patch.setattr(module, "atomic_writer", writer)


def same(one: Model, other: Model) -> bool:
    """Whether two models are, bit for bit."""
    states = one.network.state_dict(), other.network.state_dict()
    return one.report.curve == other.report.curve and all(
        torch.equal(states[0][name], states[1][name]) for name in states[0] | states[1]
    )


@pytest.mark.thorough
@pytest.mark.parametrize("room", [0, 1000])
@pytest.mark.parametrize(
    ("module", "name", "kept"),
    [
        (store, "000002.npz", ["000000.npz", "000001.npz"]),
        (checkpoint, "training", ["000000.npz", "000001.npz", "000002.npz"]),
        (checkpoint, "m.fide", ["000000.npz", "000001.npz", "000002.npz", "training"]),
    ],
)
def test_what_was_written_stays_and_the_same_call_goes_on(
    module: Any, name: str, kept: list[str], room: int, tmp_path: Path
) -> None:
    out, folder = tmp_path / "m.fide", tmp_path / "m.fide.renders"
    message = f"cannot write .*{name}: No space left on device; make room"
    with pytest.MonkeyPatch.context() as patch:
        fill_the_disk(patch, module, name, room)
        with pytest.raises(OSError, match=message) as caught:
            learn(gradient, 2, out=out, **ARGUMENTS)
    assert caught.value.errno == errno.ENOSPC
    assert set(os.listdir(folder)) == {*kept, "settings"} and not out.exists()
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.npz")}

    went_on = learn(gradient, 2, out=out, **ARGUMENTS)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert same(went_on, learn(gradient, 2, **ARGUMENTS))


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
    assert set(os.listdir("m.fide.renders")) == {"000000.npz", "000001.npz", "settings"}

    again = shlex.split(said.rpartition("continue with: ")[2])
    assert again[-1] == "--resume" and main(again[1:]) == 0
    assert "renders 300/300" in capsys.readouterr().err
    assert main([str(word) for word in ("learn", *words, "--renders", 300, "--out", "n.fide")]) == 0
    assert same(Model.load("m.fide"), Model.load("n.fide"))
