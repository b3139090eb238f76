"""Warnings that name the line of the user, however deep in the library they are noticed.

A fixed `stacklevel` names another line as soon as a function is called in two ways, or through a
decorator: one that is a context manager has a frame of its own, in contextlib.py.
"""

from __future__ import annotations

import sys
import warnings

__all__ = ["warn_user"]

_OURS = frozenset({"fide_plugins", "fide_adapters", "fide_tasks", "contextlib"})


def warn_user(message: str, category: type[Warning] = RuntimeWarning) -> None:
    """Warn at the innermost line that is not of this library."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and _is_ours(frame.f_globals.get("__name__")):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def _is_ours(module: object) -> bool:
    return isinstance(module, str) and module.partition(".")[0] in _OURS
