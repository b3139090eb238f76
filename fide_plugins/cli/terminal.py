"""Text for a terminal: one line per message, without control characters."""

from __future__ import annotations

import os
import shlex
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fide_plugins.errors import FideError

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


def discard(stream: Any) -> None:
    """What is printed to a stream is lost from now on, and what it has not written yet."""
    with suppress(OSError, ValueError, AttributeError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


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


def number(value: float | None) -> str:
    """Format a loss."""
    return "none" if value is None else f"{value:.4g}"
