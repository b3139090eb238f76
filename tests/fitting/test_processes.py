"""A worker process that cannot start."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from fide_plugins import fit

from .scene import SPACE, disk, target


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
