"""A program that is run to its end, with a time limit, its output, a folder for its files."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path

_SHOWN, _MOST = 20, 4000  # last lines of the output that an error shows; characters of them
_RUNNING: set[subprocess.Popen[bytes]] = set()  # in groups of their own


@dataclass(frozen=True)
class Ended:
    """How a program ended.

    code: its exit code, negative for a signal; None: it was stopped after the time limit.
    tail: the last lines that it wrote to standard output and standard error.
    """

    code: int | None
    tail: str


def run(command: Sequence[str], log: Path, timeout: float | None) -> Ended:
    """Run a program in the current folder, its output in the file `log`.

    All it has started is stopped with it: after `timeout` seconds, when this process is
    interrupted, or when it ends while a thread waits.  So the program gets a process group of its
    own; but in a worker process that leads one, it stays in that: who kills the worker kills it.
    """
    leads, late = _is_leader(), threading.Event()
    with log.open("wb") as output:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=os.name == "posix" and not leads,
        )
    if not leads:
        _RUNNING.add(child)

    def stop() -> None:
        if child.returncode is None:
            late.set()
            with suppress(OSError):
                child.kill() if leads else _kill(child)

    timer = threading.Timer(threading.TIMEOUT_MAX if timeout is None else timeout, stop)
    timer.daemon = True
    try:
        timer.start()
        code = child.wait()  # `wait` with a limit notices the end late
    finally:
        timer.cancel()
        if child.returncode is None or (late.is_set() and leads):
            _stop(child, leads)
        _RUNNING.discard(child)
    return Ended(None if late.is_set() else code, tail_of(log))


@atexit.register
def _stop_all() -> None:
    """Kill what threads wait for, which come to no end of their own when this process ends."""
    for child in list(_RUNNING):
        with suppress(OSError):
            _kill(child)


def _is_leader() -> bool:
    """Whether this is a worker process whose group has nobody else but what it has started."""
    if parent_process() is None or os.name != "posix":
        return False
    is_main = threading.current_thread() is threading.main_thread()  # `_stop` sets a handler
    return is_main and os.getpgrp() == os.getpid()


def _stop(child: subprocess.Popen[bytes], leads: bool) -> None:
    with suppress(OSError):  # it has ended
        if leads:
            before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the group has this process
            os.killpg(0, signal.SIGTERM)
            child.kill()
            signal.signal(signal.SIGTERM, before)
        else:
            _kill(child)
    child.wait()


def _kill(child: subprocess.Popen[bytes]) -> None:
    if os.name == "posix":
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()


def tail_of(log: Path) -> str:
    """Last lines of a text file, without control characters."""
    with log.open("rb") as file:
        file.seek(max(0, os.path.getsize(log) - _MOST))
        text = file.read().decode(errors="replace")
    lines = text.replace("\r", "\n").splitlines()
    kept = ["".join(c for c in line if c.isprintable() or c == "\t") for line in lines]
    return "\n".join([line for line in kept if line.strip()][-_SHOWN:])


_PARENT: list[str] = []
"""Folder of this process; empty: that of the system."""


def use_folder(folder: str) -> None:
    """Keep the files of all further renders of this process in a folder."""
    _PARENT[:] = [folder]


@contextmanager
def folder_of_a_render() -> Iterator[Path]:
    """A new folder, which is removed at the end of the block."""
    parent = _PARENT[0] if _PARENT else None
    with tempfile.TemporaryDirectory(
        prefix="fide-", dir=parent, ignore_cleanup_errors=True
    ) as name:
        yield Path(name)
