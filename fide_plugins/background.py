"""Work in a thread of its own, whose result does not depend on that.

Whoever starts it keeps its hands off what the work changes until `wait` has returned.  A process
that forks waits first: the child gets one thread only, and would be left with work half done.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from weakref import WeakSet

__all__ = ["Background"]


class Background:
    """One piece of work at a time."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None
        _ALL.add(self)

    def start(self, work: Callable[[], object], what: str) -> None:
        """Begin with `work`, when the last one is done; what: in words, for errors.

        Raises what the last one raised, and then does not begin.
        """
        self.wait()
        self._thread = threading.Thread(target=self._run, args=(work, what), name=what)
        self._thread.start()

    def wait(self) -> None:
        """Return when nothing is under way; raises, once, what the work raised."""
        self._join()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _join(self) -> None:
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()  # may be interrupted by Ctrl-C; the work then goes on
            self._thread = None

    def _run(self, work: Callable[[], object], what: str) -> None:
        try:
            work()
        except BaseException as error:
            error.add_note(f"raised in the background, by {what}")
            self._error = error


_ALL: WeakSet[Background] = WeakSet()


def _join_all() -> None:
    for background in list(_ALL):
        background._join()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(before=_join_all)
