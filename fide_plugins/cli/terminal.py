"""Text for a terminal: one line per message, without control characters; and its streams."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fide_plugins.errors import DependencyError, FideError

USAGE_ERRORS = (FideError, ValueError, TypeError, OSError, ImportError)
"""Errors of the arguments or the installation, raised before anything is rendered."""


def plain(text: object) -> str:
    """`text` on one line, with unprintable characters (such as escapes) written out."""
    return _printable(" ".join(str(text).split()))


def as_typed(words: Iterable[str]) -> str:
    """Words of a command, to be pasted into a shell; unprintable characters are written out."""
    return _printable(shlex.join(words))


def continuation(command: list[str], out: str | None = None) -> str:
    """The same command line, made to resume; in `out`, if it names no --out itself."""
    words = [word for word in command if word != "--resume"]
    if out is not None and not any(word == "--out" or word.startswith("--out=") for word in words):
        words += ["--out", out]
    return as_typed([*words, "--resume"])


def paragraph(text: object) -> str:
    """`text` with its lines and their indentation, other unprintable characters written out."""
    return "\n".join(map(_printable, str(text).expandtabs().split("\n"))).rstrip()


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def complain(who: str, message: object) -> int:
    """Print a usage error on standard error, in one line; returns 2."""
    note(f"{who}: {plain(message)}")
    return 2


def note(text: str) -> None:
    """Print a line to standard error; where that cannot be, the work goes on without."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr)


@contextmanager
def notices(logger: str) -> Iterator[None]:
    """Within this block, print the messages of a logger to standard error."""

    class Notes(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            note(plain(record.getMessage()))

    log, handler = logging.getLogger(logger), Notes(logging.INFO)
    before = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]


@contextmanager
def warnings_as_notes(who: str) -> Iterator[None]:
    """Within this block, warnings are messages, without place and line."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *rest: note(f"{who}: {paragraph(message)}")
        yield


def picture_in(out: Path) -> str:
    """The picture of a run directory that shows most: summary.png, or best.png without figures."""
    found = [name for name in ("summary.png", "best.png") if (out / name).exists()]
    return plain(out / found[0] if found else out)


def write_figure(who: str, path: Path, make: Callable[[], bytes]) -> Path | None:
    """Write a figure to `path`; None, with a note, without matplotlib, which is an extra."""
    from fide_plugins.runtime.files import write_bytes

    try:
        write_bytes(path, make())
    except DependencyError as error:
        note(f"{who}: {path.name} is left out: {error}")
        return None
    return path


def number(value: float | None) -> str:
    """Format a loss."""
    return "none" if value is None else f"{value:.4g}"


def duration(seconds: float) -> str:
    """Format a duration in seconds."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


# -- standard streams: closed by whoever started the command, or leading to a full disk ------------


class OutputError(Exception):
    """Standard output cannot be written; says why."""


@contextmanager
def standard_streams() -> Iterator[None]:
    """Within this block, closed streams lead nowhere, and output that is lost is an `OutputError`.

    A file that was opened where standard error is closed would get the messages.  A pipe that
    nobody reads any longer stays a BrokenPipeError.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free
    before = sys.stdin, sys.stdout, sys.stderr
    with open(os.devnull) as nothing, open(os.devnull, "w") as nowhere:
        sys.stdin, sys.stderr = before[0] or nothing, before[2] or nowhere
        sys.stdout = _Output(before[1] or nowhere)
        try:
            yield
            sys.stdout.flush()
        finally:
            sys.stdin, sys.stdout, sys.stderr = before


def discard(stream: Any) -> None:
    """What is printed to a stream is lost from now on, and what it has not written yet."""
    with suppress(OSError, ValueError, AttributeError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


class _Output:
    """Standard output, whose errors are told from those of the files of a run."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return int(self._told(self._stream.write, text))

    def flush(self) -> None:
        self._told(self._stream.flush)

    def _told(self, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputError(error.strerror or str(error)) from error
