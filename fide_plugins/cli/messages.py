"""Text for a terminal: one line a message, and nothing that could control the terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["complain", "duration", "note", "notices", "number", "plain"]


def plain(text: object) -> str:
    """`text` on one line, with everything unprintable (such as escapes) written out."""
    words = " ".join(str(text).split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in words)


def complain(who: str, message: object) -> int:
    """Say on standard error, in one line, what was wrong with the usage; returns 2."""
    note(f"{who}: {plain(message)}")
    return 2


def note(text: str) -> None:
    """Print a line to standard error."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def notices(logger: str) -> Iterator[None]:
    """Within this block, print what that logger is told to standard error."""

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


def number(value: float | None) -> str:
    """A loss, for people."""
    return "none" if value is None else f"{value:.4g}"


def duration(seconds: float) -> str:
    """Seconds, for people."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
