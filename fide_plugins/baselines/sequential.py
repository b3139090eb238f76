"""Baselines whose library evaluates one point after the other."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np

from fide_plugins.baselines.replay import Replayed
from fide_plugins.baselines.reverse_communication import ReverseCommunication, Search
from fide_plugins.errors import OptionError, ProtocolError
from fide_plugins.types import Float32, Float64

__all__ = ["Penalty", "Sequential", "quietly"]


class Penalty:
    """Finite losses in place of those that are not: worse than all before."""

    def __init__(self) -> None:
        self._worst: float | None = None

    def __call__(self, loss: float) -> float:
        """`loss` itself if it is finite."""
        if np.isfinite(loss):
            self._worst = loss if self._worst is None else max(loss, self._worst)
            return loss
        worst = 0.0 if self._worst is None else self._worst
        return min(worst + 1.0 + abs(worst), float(np.finfo(float).max))


@contextmanager
def quietly() -> Iterator[None]:
    """Without a library's warnings, as of flat or failed functions, which here are no error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class Sequential(Replayed):
    """A library's search, one evaluation at a time: its population is 1.

    If more is asked before the result is told, the same point is given again.  Only the first
    result of it is used; the others are counted.  When a search is over, the next one begins.
    """

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        if self.popsize != 1:
            raise OptionError(
                f"popsize must be 1 for {self.name}, which evaluates one point after the other, "
                f"not {self.popsize}"
            )
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

    def _answer(self, loss: float, features: Float32 | None) -> Any:
        """What the library's function returns."""
        return self._penalty(loss)

    def _sample(self) -> Float64:
        """The point that the search waits at, (1, dim)."""
        if self._closed:
            raise ProtocolError(f"this {self.name} was closed; make or load another one")
        for _ in range(2):  # a search that is over is followed by another, which has a point
            if self._library is None or self._library.over:
                self._library = ReverseCommunication(self._search(), self._surroundings())
                self.starts += 1
            point = self._library.point()
            if point is not None:
                return np.clip(point, 0.0, 1.0)[None]
        raise ProtocolError(f"{self.name} ended without evaluating a point; start a new one")

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._population.forget_pending()
        if self._library is not None:
            of_image = None if features is None else features[0]
            self._library.answer(self._answer(float(losses[0]), of_image))

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        """What to enter whenever the search goes on; like it, it must not refer to self."""
        return quietly

    def _default_popsize(self) -> int:
        return 1
