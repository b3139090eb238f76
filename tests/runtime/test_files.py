"""Atomic files, and locks."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fide_plugins.runtime import files

needs_locks = pytest.mark.skipif(not hasattr(os, "fork"), reason="no such locks on Windows")


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
    for name in (".run.json.0123456789ab.tmp", "mine.tmp", ".hidden", ".notes.tmp"):
        (tmp_path / name).touch()
    files.remove_leftovers(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [".hidden", ".notes.tmp", "mine.tmp"]


HOLDER = """
import os, sys, time
from fide_plugins.runtime import files

with files.locked(sys.argv[1]):
    if os.fork() == 0:
        print(os.getpid(), flush=True)
        time.sleep(60)
        os._exit(0)
    time.sleep(60)
"""


@needs_locks
def test_a_lock_ends_with_its_process_also_where_a_forked_one_lives_on(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        child = int(holder.stdout.readline())
        try:
            with files.locked(tmp_path / "lock") as mine:
                assert not mine
            holder.kill()
            holder.wait()
            with files.locked(tmp_path / "lock") as mine:
                assert mine
        finally:
            os.kill(child, signal.SIGKILL)


@needs_locks
def test_whether_a_lock_is_held_is_told_without_making_or_keeping_one(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    assert files.is_locked(path) is None and not path.exists()
    with files.locked(path):
        assert files.is_locked(path) is True
    assert files.is_locked(path) is False
    with files.locked(path) as mine:
        assert mine


@needs_locks
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_stops_nothing(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", none)
    with files.locked(tmp_path / "lock") as mine:
        assert mine
