"""The current folder of a user's code, which may change it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from fide_plugins.errors import OptionError

__all__ = ["OwnFolder"]


class OwnFolder:
    """Keeps the current folder of a user's code apart from that of FIDE.

    Scripts call `os.chdir` to find their files.  The paths of targets and of the run directory are
    relative to the folder in which FIDE was started.

    All threads of a process have one current folder.  So a block that begins in another thread than
    the main one changes nothing, and is refused if code of the main thread has gone elsewhere.
    """

    def __init__(self) -> None:
        self._left: str | None = None  # None: that of FIDE

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Go where the code was at the end of the last block; go back at the end of this one.

        Raises OptionError (a ValueError) in another thread, if the code was elsewhere then.
        """
        if threading.current_thread() is not threading.main_thread():
            self._check_is_here()
            yield
            return
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

    def _check_is_here(self) -> None:
        if self._left is not None:
            raise OptionError(
                "the renderer's code has called os.chdir, and all threads of a process have one "
                f"current folder, not both {_here()} and {self._left}: render in processes, or "
                "let the code find its files without os.chdir (Path(__file__).parent)"
            )


def _here() -> str | None:
    """The current folder; None if it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return None
