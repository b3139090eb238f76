"""A bandit that chooses among moves by what each brought for its evaluations.

The gain of a move is the fraction by which it lowered the loss, and 0 where it failed. Its rate is
the gain per evaluation; old outcomes count less and less. Moves are drawn in proportion to their
rates, each with a least probability, so that none is given up: what helps at a loss of 0.01 may be
useless at 0.001, and the other way round. A move that was not tried yet is taken to be good.
(pyribs schedules its emitters alike: `ribs.schedulers.BanditScheduler`.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fide_plugins.runtime.schema import check, real, row
from fide_plugins.types import Float64

__all__ = ["Choice"]

_KEEP = 0.85  # of what is known, at each outcome of the same move
_PRIOR_TRIES = 2.0  # that the prior gain is worth
_FLOOR = 0.3  # of all draws are even
_LEAST = 1e-300  # gain or cost that can be
_VAIN = 1e-200  # gain after thousands of vain tries, of which rates can still be compared


class Choice:
    """Gains and costs of the moves.

    priors: of each move by its name, the gain in a try that is expected at first, above 0.
    cost: evaluations that a try takes, roughly.
    """

    def __init__(self, priors: Mapping[str, float], cost: float) -> None:
        self.names = tuple(priors)
        self._gain = _PRIOR_TRIES * np.array(list(priors.values()))
        self._cost = np.full(len(priors), _PRIOR_TRIES * cost)
        self._untried = self._gain.copy(), self._cost.copy()

    def note(self, name: str, gain: float, evaluations: int) -> None:
        """Note the outcome of a move."""
        i = self.names.index(name)
        self._gain[i] = max(_VAIN, _KEEP * self._gain[i] + min(max(gain, 0.0), 1.0))
        self._cost[i] = _KEEP * self._cost[i] + evaluations

    def probabilities(self, possible: Sequence[str]) -> Float64:
        """Probabilities of those moves."""
        which = [self.names.index(name) for name in possible]
        rates = self._gain[which] / self._cost[which]
        even = 1.0 / len(which)
        p: Float64 = _FLOOR * even + (1 - _FLOOR) * rates / rates.sum()
        return np.asarray(p / p.sum(), np.float64)

    def draw(self, possible: Sequence[str], rng: np.random.Generator) -> str:
        """Draw one of those moves."""
        return possible[int(rng.choice(len(possible), p=self.probabilities(possible)))]

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes: gain and cost of each move, by its name."""
        pairs = zip(self._gain.tolist(), self._cost.tolist(), strict=True)
        return {name: list(pair) for name, pair in zip(self.names, pairs, strict=True)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; a move that it lacks has not been tried.

        Raises ValueError for what it cannot have given.
        """
        if not isinstance(state, dict):
            raise ValueError("choice is no dict")
        pair = row(real(_LEAST), real(_LEAST))
        check(state, {name: pair for name in self.names if name in state}, {}, "choice")
        gain, cost = (untried.copy() for untried in self._untried)
        for name, values in state.items():
            i = self.names.index(name)
            gain[i], cost[i] = values
        self._gain, self._cost = gain, cost
