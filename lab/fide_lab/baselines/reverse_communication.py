"""Reverse communication: a library that calls a function is driven by ask and tell.

The library runs in a thread of its own, which works only while the user's thread waits for it.  So
the two never compute at the same time, and results do not depend on timing.  The thread ends when
the library returns, when its `ReverseCommunication` is closed or garbage-collected, and when Python
exits.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from queue import SimpleQueue
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.types import Float64

__all__ = ["ReverseCommunication", "Search"]

Search: TypeAlias = Callable[[Callable[[Float64], Any]], None]
"""search(function) calls function(x) with points (d,), one after the other, until it is done."""


class _Cancelled(BaseException):
    """Raised in the library's thread, through it, to end it."""


class _Channel:
    """The queues between the two threads."""

    def __init__(self) -> None:
        self.points: SimpleQueue[Float64 | BaseException | None] = SimpleQueue()
        self.answers: SimpleQueue[Any] = SimpleQueue()

    def evaluate(self, x: Float64) -> Any:
        """The library's function, in its thread."""
        self.points.put(np.array(x, np.float64))
        answer = self.answers.get()
        if isinstance(answer, _Cancelled):
            raise answer
        return answer

    def work(self, search: Search) -> None:
        """All that the thread does."""
        try:
            search(self.evaluate)
        except _Cancelled:
            return
        except BaseException as error:
            self.points.put(error)
        else:
            self.points.put(None)


class ReverseCommunication:
    """A search that waits at each point for its value.

    search: must not refer to this object, or its thread would keep it alive.
    around: entered whenever the search goes on, and left at its next point.
    """

    def __init__(
        self, search: Search, around: Callable[[], AbstractContextManager[Any]] = nullcontext
    ) -> None:
        self._search, self._around = search, around
        self._channel = _Channel()
        self._thread: threading.Thread | None = None
        self._end: weakref.finalize[..., Any] | None = None
        self._point: Float64 | None = None
        self._running = False  # whether the search works; still so after Ctrl-C in the meantime
        self.over = False
        """Whether the search is done."""

    def point(self) -> Float64 | None:
        """Point (d,) whose value the search waits for; None when it is over.

        Raises whatever the search raised.
        """
        if self._thread is None:
            work = self._channel.work
            self._thread = threading.Thread(target=work, args=(self._search,), daemon=True)
            self._end = weakref.finalize(self, _cancel, self._channel, self._thread)
            self._go_on(self._thread.start)
        if self._running:  # Ctrl-C came while it was waited for
            with self._around():
                self._wait()
        return self._point

    def answer(self, value: Any) -> None:
        """Give the value at the point, and let the search go on to its next one."""
        self._go_on(lambda: self._channel.answers.put(value))

    def close(self) -> None:
        """End the search and its thread; there is no further point."""
        if self._end is not None:
            self._end()
        self._point, self.over = None, True

    def _go_on(self, start: Callable[[], None]) -> None:
        if self.over:
            return
        with self._around():
            self._running = True
            start()
            self._wait()

    def _wait(self) -> None:
        point = self._channel.points.get()
        self._running = False
        self._point = point if isinstance(point, np.ndarray) else None
        self.over = self._point is None
        if isinstance(point, BaseException):
            raise point


def _cancel(channel: _Channel, thread: threading.Thread) -> None:
    channel.answers.put(_Cancelled())
    if thread is not threading.current_thread():
        thread.join()
