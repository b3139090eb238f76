"""The current folder of a user's code, which may change it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["OwnFolder"]


class OwnFolder:
    """Keeps the current folder of a user's code apart from that of FIDE.

    Scripts call `os.chdir` to find their files.  The paths of targets and of the run directory are
    relative to the folder in which FIDE was started.
    """

    def __init__(self) -> None:
        self._left: str | None = None  # None: that of FIDE

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Go where the code was at the end of the last block; go back at the end of this one."""
        before = _here()
        if self._left is not None:
            with suppress(OSError):  # it was removed meanwhile
                os.chdir(self._left)
        try:
            yield
        finally:
            now = _here()
            self._left = None if now == before else now
            if before is not None and now != before:
                os.chdir(before)


def _here() -> str | None:
    """The current folder; None if it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return None
