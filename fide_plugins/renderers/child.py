"""A program that is run to its end, with a time limit and captured output."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import parent_process
from pathlib import Path
from types import FrameType
from typing import IO, Any

__all__ = ["Ended", "run", "tail_of"]

_SHOWN = 20  # last lines of the output that an error shows
_MOST = 4000  # characters of them


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

    The program gets no standard input.  All it has started is stopped with it: after `timeout`
    seconds, or when this process is interrupted.  To know what that is, the program gets a process
    group of its own; but in a worker process that leads one, it stays in that, so that who kills
    the worker's group kills the program, too.

    Raises OSError if it cannot be started.
    """
    with log.open("wb") as output:
        child = None
        try:
            with _held(signal.SIGINT, signal.SIGTERM):  # until it is known what is to be stopped
                child = _start(command, output)
            code: int | None = child.wait(timeout)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if child is not None and child.returncode is None:
                _stop(child)
    return Ended(code, tail_of(log))


@contextmanager
def _held(*signals: signal.Signals) -> Iterator[None]:
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
    if os.name != "posix":
        child.kill()
    elif not _is_leader():
        os.killpg(child.pid, signal.SIGKILL)
    else:
        before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the group has this process, too
        os.killpg(0, signal.SIGTERM)
        child.kill()
        signal.signal(signal.SIGTERM, before)
    child.wait()


def tail_of(log: Path) -> str:
    """Last lines of a text file, without control characters."""
    with log.open("rb") as file:
        file.seek(max(0, os.path.getsize(log) - _MOST))
        text = file.read().decode(errors="replace")
    lines = text.replace("\r", "\n").splitlines()
    kept = ["".join(c for c in line if c.isprintable() or c == "\t") for line in lines]
    return "\n".join([line for line in kept if line.strip()][-_SHOWN:])
