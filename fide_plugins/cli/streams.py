"""Standard streams of a command: closed by whoever started it, or leading to a full disk."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

__all__ = ["OutputError", "lose", "standard_streams"]


class OutputError(Exception):
    """Standard output cannot be written; says why."""


@contextmanager
def standard_streams() -> Iterator[None]:
    """Within this block, closed streams lead nowhere, and output that is lost is an `OutputError`.

    A file that was opened where standard error is closed would get the messages.  A pipe that
    nobody reads any longer stays a BrokenPipeError.
    """
    _open_closed()
    before = sys.stdin, sys.stdout, sys.stderr
    with open(os.devnull) as nothing, open(os.devnull, "w") as nowhere:
        sys.stdin, sys.stderr = before[0] or nothing, before[2] or nowhere
        sys.stdout = _Output(before[1] or nowhere)
        try:
            yield
            sys.stdout.flush()
        finally:
            sys.stdin, sys.stdout, sys.stderr = before


def lose(stream: Any) -> None:
    """What is printed to a stream is lost from now on, and what it has not written yet."""
    with suppress(OSError, ValueError, AttributeError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def _open_closed() -> None:
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free


class _Output:
    """Standard output, whose errors are told from those of the files of a run."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _told():
            return int(self._stream.write(text))

    def flush(self) -> None:
        with _told():
            self._stream.flush()


@contextmanager
def _told() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(error.strerror or str(error)) from error
