"""Atomic files."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from fide_plugins.runtime import files


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    files.write_text(path, "old λ")
    with pytest.raises(ZeroDivisionError), files.atomic_writer(path) as file:
        file.write(b"half of the n")
        assert path.read_text("utf-8") == "old λ"
        _ = 1 // 0
    assert path.read_text("utf-8") == "old λ"
    files.write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_the_mode_is_that_of_an_ordinary_file(tmp_path: Path) -> None:
    (tmp_path / "ordinary").touch()
    files.write_text(tmp_path / "ours", "x")
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ordinary", "ours")}
    assert len(modes) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_an_error_that_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.write_text(tmp_path / "a", "old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="cannot write .*a: No space left.*; make room") as caught:
        files.write_text(tmp_path / "a", "new")
    assert caught.value.errno == 28
    assert (tmp_path / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


def test_folders_that_cannot_be_written(tmp_path: Path) -> None:
    files.check_writable(tmp_path / "new" / "deep")
    assert os.listdir(tmp_path / "new" / "deep") == []
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="cannot write to the folder .*file"):
        files.check_writable(tmp_path / "file")
    with pytest.raises(OSError, match="cannot write to the folder"):
        files.check_writable("/proc/none")


def test_leftovers_of_a_killed_writer_are_removed(tmp_path: Path) -> None:
    for name in (".run.json.0123.tmp", "mine.tmp", ".hidden"):
        (tmp_path / name).touch()
    files.remove_leftovers(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [".hidden", "mine.tmp"]
