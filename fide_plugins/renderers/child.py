"""A program that is run to its end, with a time limit, its output, a folder for its files."""

from __future__ import annotations

import atexit
import math
import os
import select
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from types import FrameType
from typing import IO, Any

_SHOWN = 20  # last lines of the output that an error shows
_MOST = 4000  # characters of them
_LONGEST = 2**24  # bytes of output, beyond which its file begins again
_LOOK = 0.1  # seconds between two looks at its length
_RUNNING: set[subprocess.Popen[bytes]] = set()  # in groups of their own
_ENDING = threading.Event()  # this process


@dataclass(frozen=True)
class Ended:
    """How a program ended.

    code: its exit code, negative for a signal; None: it was stopped after the time limit.
    tail: the last lines that it wrote to standard output and standard error.
    """

    code: int | None
    tail: str


def run(command: Sequence[str], log: Path, timeout: float | None) -> Ended:
    """Run a program in the current folder, the end of its output in the file `log`.

    The program gets no standard input.  All it has started is stopped with it: after `timeout`
    seconds, when this process is interrupted, or when it ends while a thread waits.  To know what
    that is, the program gets a process group of its own; but in a worker process that leads one, it
    stays in that, so that who kills the worker's group kills the program, too.
    """
    log.unlink(missing_ok=True)
    with log.open("a+b", buffering=0) as output:  # "a": after `_shorten`, too, it goes to the end
        child = None
        try:
            # until it is known what is to be stopped
            with _deferred(signal.SIGINT, signal.SIGTERM):
                child = _start(command, output)
                if not _is_leader():
                    _RUNNING.add(child)
            if _ENDING.is_set():
                raise OSError("this process ends, so it starts no other program")
            with _kept_short(output):
                code = _wait(child, timeout)
        finally:
            if child is not None:
                if child.returncode is None:
                    _stop(child)
                _RUNNING.discard(child)
    return Ended(code, tail_of(log))


@atexit.register
def _stop_all() -> None:
    """Kill what threads wait for, which come to no end of their own when this process ends."""
    _ENDING.set()
    for child in list(_RUNNING):
        with suppress(OSError):
            _kill(child)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_RUNNING.clear)  # they are of the parent


def _wait(child: subprocess.Popen[bytes], timeout: float | None) -> int | None:
    ended = None if timeout is None else _ends_within(child, timeout)
    if ended is False:
        return None
    try:
        return child.wait(timeout if ended is None else None)
    except subprocess.TimeoutExpired:
        return None


def _ends_within(child: subprocess.Popen[bytes], timeout: float) -> bool | None:
    """Whether the program ends within so many seconds; None where the system does not tell.

    `wait` with a limit looks every 50 ms whether the program has ended; Linux tells at once.
    """
    if not hasattr(os, "pidfd_open") or timeout * 1000 >= 2**31 - 1:
        return None
    try:
        descriptor = os.pidfd_open(child.pid)
    except OSError:
        return None
    try:
        ended = select.poll()
        ended.register(descriptor, select.POLLIN)
        return bool(ended.poll(math.ceil(timeout * 1000)))
    finally:
        os.close(descriptor)


@contextmanager
def _kept_short(output: IO[bytes]) -> Iterator[None]:
    """Keep a file short meanwhile: a program that prints in a loop would fill the disk.

    A thread does it: who waits for the program with pauses notices its end late.
    """
    over = threading.Event()

    def keep() -> None:
        while not over.wait(_LOOK):
            with suppress(OSError):  # on a disk that is full already
                _shorten(output)

    thread = threading.Thread(target=keep, name="fide-output", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _shorten(output: IO[bytes]) -> None:
    length = os.fstat(output.fileno()).st_size
    if length > _LONGEST:
        output.seek(length - _MOST)
        end = output.read(_MOST)
        output.truncate(0)
        output.write(end)


@contextmanager
def _deferred(*signals: signal.Signals) -> Iterator[None]:
    """Call the handlers of signals that arrive meanwhile at the end; only in the main thread.

    Signals without a handler in Python, such as ignored ones, are left alone: a program that is
    started meanwhile inherits that they are ignored.
    """
    arrived: list[tuple[int, FrameType | None]] = []
    before: dict[signal.Signals, Callable[[int, FrameType | None], Any]] = {}
    if threading.current_thread() is threading.main_thread():
        for number in signals:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
    try:
        for number in before:
            signal.signal(number, lambda *call: arrived.append(call))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for which, frame in arrived:
            before[signal.Signals(which)](which, frame)


def _start(command: Sequence[str], output: IO[bytes]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        start_new_session=os.name == "posix" and not _is_leader(),
    )


def _is_leader() -> bool:
    """Whether this is a worker process whose group has nobody else but what it has started."""
    if parent_process() is None or os.name != "posix":
        return False
    here = threading.current_thread() is threading.main_thread()  # `_stop` sets a handler
    return here and os.getpgrp() == os.getpid()


def _stop(child: subprocess.Popen[bytes]) -> None:
    """Stop a program that has not been waited for, so that its number is still its own."""
    if not _is_leader():
        _kill(child)
    else:
        before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the group has this process, too
        os.killpg(0, signal.SIGTERM)
        child.kill()
        signal.signal(signal.SIGTERM, before)
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
