"""Text for a terminal: one line per message, without control characters."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

from fide_plugins.cli.streams import lose
from fide_plugins.errors import FideError

__all__ = [
    "USAGE_ERRORS",
    "as_typed",
    "complain",
    "continuation",
    "duration",
    "note",
    "notices",
    "number",
    "paragraph",
    "plain",
    "warnings_as_notes",
]

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
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            _lose_output_there()
        lose(sys.stderr)


def _lose_output_there() -> None:
    """Lose standard output, too, if it is the pipe that nobody reads."""
    with suppress(OSError, ValueError, AttributeError):
        if os.path.sameopenfile(sys.stdout.fileno(), sys.stderr.fileno()):
            lose(sys.stdout)


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
