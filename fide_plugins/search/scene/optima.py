"""Distinct local optima, and how often moves from each of them failed.

The next incumbent is the optimum with the lowest *score*, its rank by loss plus its failures in
units of a tolerance: the best one is tried first, and others when it has failed often. A new
search is due when its own score is lower still.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from torch import device

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.types import Float64

__all__ = ["APART", "Optima", "Optimum"]

Distance: TypeAlias = Callable[[Float64, Float64], float]

_MOST = 12  # that are remembered
APART = 0.05  # of the unit cube, in some parameter, that makes two optima distinct
_NEW, _NEW_AGAIN = 1.0, 0.5  # score of the first new search; added by each without a success


@dataclass(slots=True)
class Optimum:
    """A local optimum.

    failures: of moves from it.
    searches: that ended there and had begun elsewhere; no move is chosen by them.
    refined: whether `refine` was tried.
    """

    sample: TrainingSample
    failures: int = 0
    searches: int = 1
    refined: bool = False


class Optima:
    """Local optima, best first."""

    def __init__(self) -> None:
        self.all: list[Optimum] = []
        self.forgotten = 0
        """Of these searches, those that ended in places which are no longer remembered."""
        self._descents = 0  # new ones since the best optimum was found

    def __len__(self) -> int:
        return len(self.all)

    def note(
        self, found: TrainingSample, distance: Distance, *, from_elsewhere: bool = True
    ) -> bool:
        """Note where a search ended; returns whether that is the best optimum so far.

        distance: of two points (d,), in units of the unit cube.
        from_elsewhere: whether the search had begun elsewhere.
        """
        best = not self.all or found.loss < self.all[0].sample.loss
        if best:
            self._descents = 0
        near = [o for o in self.all if distance(o.sample.x, found.x) < APART]
        searches = int(from_elsewhere) + sum(optimum.searches for optimum in near)
        if near and near[0].sample.loss <= found.loss:
            near[0].searches += int(from_elsewhere)
            return False
        self.all = [optimum for optimum in self.all if optimum not in near]
        self.all.append(Optimum(found, searches=searches))
        self.all.sort(key=lambda optimum: optimum.sample.loss)
        self.forgotten += sum(optimum.searches for optimum in self.all[_MOST:])
        del self.all[_MOST:]
        return best

    def others(self, distance: Distance) -> tuple[float | None, float]:
        """How far the answers of searches differ that ended in other places than the best.

        Their lowest loss, None without any, and the largest distance of one from the best place.
        Those count that had begun elsewhere.
        """
        found = [optimum.sample for optimum in self.all[1:] if optimum.searches]
        if not found:
            return None, 0.0
        best = self.all[0].sample.x
        return found[0].loss, max(distance(best, one.x) for one in found)

    def fail(self, incumbent: TrainingSample) -> None:
        """Note that a move from this optimum failed."""
        optimum = self.of(incumbent)
        if optimum is not None:
            optimum.failures += 1

    def of(self, sample: TrainingSample) -> Optimum | None:
        """Return the optimum with this sample, if it is remembered."""
        return next((optimum for optimum in self.all if optimum.sample is sample), None)

    def next(self, tolerance: float) -> TrainingSample | None:
        """Return the optimum that is tried next; None: it is time for a new search.

        tolerance: failures that outweigh one rank.
        """
        scores = [rank + one.failures / tolerance for rank, one in enumerate(self.all)]
        if not scores or min(scores) >= _NEW + _NEW_AGAIN * self._descents:
            self._descents += 1
            return None
        return self.all[int(np.argmin(scores))].sample

    def state_dict(self) -> dict[str, Any]:
        """Everything."""
        counts = [[one.failures, one.searches, int(one.refined)] for one in self.all]
        samples = [one.sample.state_dict() for one in self.all]
        return {
            "samples": samples,
            "counts": counts,
            "descents": self._descents,
            "forgotten": self.forgotten,
        }

    def load_state_dict(self, state: Mapping[str, Any], device: device | None = None) -> None:
        """Put back what `state_dict` gave, tokens on the device."""
        samples = [TrainingSample.from_state(one, device) for one in state["samples"]]
        pairs = zip(samples, state["counts"], strict=True)
        self.all = [Optimum(one, n, m, bool(refined)) for one, (n, m, refined) in pairs]
        self._descents, self.forgotten = state["descents"], state["forgotten"]
