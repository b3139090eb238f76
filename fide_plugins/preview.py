"""Candidates of the next generation, while results of the present one are still pending.

Who asks when those told and those pending are a whole generation renders for the next one. Most
results are known by then. So a copy of the search is updated with these (line 10 of Algorithm 1),
as if they were all there will be, and the candidate is drawn from the copy. It is much nearer to
the next generation than to the present one, and counts in the next one as late.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fide_plugins.population import Candidate, Makers
from fide_plugins.search.descent import Descent
from fide_plugins.search.moves.policy import Stage
from fide_plugins.state import State
from fide_plugins.types import Float64

__all__ = ["Ahead", "previewed"]

_ENOUGH = 1 / 2  # of the results of a generation
_FEWEST = 4  # results; no generation has fewer

_Propose = Callable[[Float64, Descent, np.random.Generator], tuple[Float64, Float64, Makers]]


def previewed(state: State) -> Descent | None:
    """Return the search as it would be updated now; nothing else changes.

    None where too few results of the generation are known, or it is not of a search.
    """
    population = state.population
    enough = max(_FEWEST, _ENOUGH * population.size)
    if state.stage is not Stage.SEARCH or population.evaluated < enough:
        return None
    return state.descent.preview(*population.members())


class Ahead:
    """Hands out candidates of the next generation, while nothing is told.

    propose: makes proposals from samples z (m, d) of a search.
    """

    def __init__(self, state: State, propose: _Propose) -> None:
        self._state, self._propose = state, propose
        self._descent: Descent | None = None  # one for all: the update takes O(d^3)

    def hand_out(self) -> Candidate | None:
        """Hand out one; None where the present generation needs more.

        It takes the place of the next candidate that was drawn, and is a proposal if that is one.
        A proposer that is asked for all of a generation at once is left to do that.
        """
        state, population, proposer = self._state, self._state.population, self._state.proposer
        needed = population.evaluated + population.pending < population.size
        if needed or not (proposer is None or proposer.singly):
            return None
        self._descent = self._descent or previewed(state)
        if self._descent is None:
            return None
        x, z = self._descent.sample(1, state.rng)  # (1, d)
        maker = 0
        if population.next_is_proposal:
            x, z, makers = self._propose(z, self._descent, state.rng)
            maker = int(makers[0])
        return population.hand_out_instead(x[0], z[0], maker)
