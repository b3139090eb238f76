"""Words of messages, and warnings that name the line of the user."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_SAID: ContextVar[set[str] | None] = ContextVar("said", default=None)

_BETWEEN = (
    *("fide_plugins", "fide_adapters", "fide_lab", "fide_tasks", "optuna", "nevergrad"),
    *("contextlib", "torch.utils._contextlib"),
)
"""Modules whose lines, and those of what is in them, are not the user's."""


def warn_user(message: str, category: type[Warning] = RuntimeWarning) -> None:
    """Warn at the innermost line that is neither of this library nor of what calls it."""
    said = _SAID.get()
    if said is not None:
        if message in said:
            return
        said.add(message)
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and _is_between(frame.f_globals.get("__name__")):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


@contextmanager
def said_once(said: set[str]) -> Iterator[None]:
    """Within this block, `warn_user` says nothing that is in `said`, and adds what it says."""
    token = _SAID.set(said)
    try:
        yield
    finally:
        _SAID.reset(token)


def _is_between(module: object) -> bool:
    return isinstance(module, str) and any(f"{module}.".startswith(f"{m}.") for m in _BETWEEN)


def counted(number: int, thing: str) -> str:
    """A number of things, in the plural unless it is one.

    >>> counted(1, "problem"), counted(2000, "problem")
    ('1 problem', '2000 problems')
    """
    return f"{number} {thing}{'s' * (number != 1)}"


def cut(text: str, most: int) -> str:
    """One line of text of at most so many characters, with both ends of a longer one.

    >>> cut("left_shoulder_rotation", 12), cut("short", 12)
    ('left_...tion', 'short')
    """
    text = " ".join(text.split())
    if len(text) <= most:
        return text
    end = (most - 3) // 2
    return f"{text[: most - 3 - end]}...{text[len(text) - end :]}"


def duration(seconds: float) -> str:
    """A duration in one unit.

    >>> duration(0.00042), duration(1.26), duration(75), duration(1500), duration(14000)
    ('0.42 ms', '1.3 s', '75 s', '25 min', '3.9 h')
    """
    if seconds < 90:
        return f"{seconds:.2g} s" if seconds >= 0.9995 else f"{seconds * 1000:.3g} ms"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.2g} h"
