"""Baselines whose library calls a function, of one point or of several at a time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from fide_lab.baselines.penalty import Penalty, quietly
from fide_lab.baselines.replay import Replayed
from fide_lab.baselines.reverse_communication import ReverseCommunication, Search
from fide_plugins.errors import ProtocolError
from fide_plugins.types import Float64

__all__ = ["CalledBack"]


class CalledBack(Replayed):
    """A library's search in a thread of its own.  When a search is over, the next one begins.

    If more is asked before the results are told, the same points are given again.  Only the first
    result of each is used; the others are counted.
    """

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        self.starts = 0  # searches begun so far
        self._penalty = Penalty()
        self._library: ReverseCommunication | None = None
        self._closed = False

    def close(self) -> None:
        """End the library's thread, as happens to an optimizer that is no longer referred to."""
        self._closed = True
        if self._library is not None:
            self._library.close()

    def _search(self) -> Search:
        """The next search, of which `starts` were begun before; it must not refer to self."""
        raise NotImplementedError

    def _points(self) -> Float64:
        """What the search waits for the values of, (n, dim) in the box; begins one if none does."""
        if self._closed:
            raise ProtocolError(f"this {self.name} was closed; make or load another one")
        for _ in range(2):  # a search that is over is followed by another, which has a point
            if self._library is None or self._library.over:
                self._library = ReverseCommunication(self._search(), self._surroundings())
                self.starts += 1
            points = self._library.point()
            if points is not None:
                return np.clip(np.atleast_2d(points), 0.0, 1.0)
        raise ProtocolError(f"{self.name} ended without evaluating a point; start a new one")

    def _go_on(self, answer: Any) -> None:
        """Answer the library's function."""
        self._population.forget_pending()
        if self._library is not None:
            self._library.answer(answer)

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        """What to enter whenever the search goes on; like it, it must not refer to self."""
        return quietly
