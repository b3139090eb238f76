"""A run directory overwrites no file that is not of its run."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fide_plugins.recording.directory import RunDirectory
from fide_plugins.recording.storage import RunDirectoryError


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize(
    "name", ["best.png", "curve.csv", "reference.png", "run.ckpt", "summary.png"]
)
def test_a_folder_with_such_files_of_someone_else_is_refused(
    name: str, resume: bool, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(RunDirectoryError, match=f"has no run.json, but {name}, which.*another"):
        RunDirectory(tmp_path, {"budget": 5}, resume=resume)
    assert (tmp_path / name).read_text() == "mine"
    assert os.listdir(tmp_path) == [name]


def test_temporary_files_of_others_stay(tmp_path: Path) -> None:
    """`fide learn` may write its model in the same folder at the same time."""
    ours, theirs = ".best.png.0123456789ab.tmp", ".scene.fide.0123456789ab.tmp"
    for name in (ours, theirs, ".optimizer-30-0.ckpt.0123456789ab.tmp"):
        (tmp_path / name).touch()
    RunDirectory(tmp_path, {"budget": 5}, resume=False).close()
    assert (tmp_path / theirs).exists() and len(list(tmp_path.glob(".*.tmp"))) == 1


def test_other_files_may_be_there(tmp_path: Path) -> None:
    """The user's target is kept: a fit may write its results beside it."""
    (tmp_path / "target.png").write_text("mine")
    (tmp_path / "scene.py").write_text("mine")
    directory = RunDirectory(tmp_path, {"budget": 5}, resume=False)
    directory.write_run()
    directory.close()
    assert (tmp_path / "target.png").read_text() == "mine"
    assert (tmp_path / "run.json").exists()
