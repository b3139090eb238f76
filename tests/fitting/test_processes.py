"""How a worker process ended, whoever asked the system first, and one that cannot start."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from fide_plugins import fit
from fide_plugins.fitting.processes import _exit_code

from .scene import SPACE, disk, target


class Ending:
    """A process of which another thread has got the code, and notes it a moment later."""

    def __init__(self, code: int | None, after: int) -> None:
        self.code, self.after = code, after

    def join(self, timeout: float) -> None:
        """Return at once: the system has nothing more to say."""

    @property
    def exitcode(self) -> int | None:
        self.after -= 1
        return self.code if self.after < 0 else None


def test_the_exit_code_is_waited_for() -> None:
    process: Any = Ending(7, after=3)
    assert _exit_code(process) == 7


def test_an_exit_code_that_nobody_knows_is_none() -> None:
    process: Any = Ending(None, after=0)
    assert _exit_code(process) is None


@pytest.mark.parametrize("step", ["__init__", "submit"])
def test_a_worker_that_cannot_start_leaves_no_folder(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With too many open files, where no folder can be opened to be looked through either."""

    def too_many(*_: object, **__: object) -> None:
        monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(ProcessPoolExecutor, step, too_many)
    with pytest.raises(OSError, match="Too many open files"):
        fit(disk(), target(), SPACE, budget=9, workers=1)
    assert list(tmp_path.iterdir()) == []
