"""Candidates of the next generation, while results of the present one are still pending.

Who asks when those told and those awaited are a whole generation renders for the next one. Most
results are known by then. So a copy of the search is updated with these (line 10 of Algorithm 1),
as if they were all there will be, and the candidate is drawn from the copy. It is much nearer to
the next generation than to the present one, and yet not of its distribution.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fide_plugins.search.moves.policy import Stage
from fide_plugins.search.one_search import Search
from fide_plugins.state import State
from fide_plugins.types import Float64

__all__ = ["make_next", "previewed"]

_ENOUGH = 1 / 2  # of the results of a generation
_FEWEST = 4  # results; no generation has fewer

_Propose = Callable[[Float64, Search, np.random.Generator], tuple[Float64, Float64]]


def previewed(state: State) -> Search | None:
    """Return the search as it would be updated now; nothing else changes.

    None where too few results of the generation are known, or it is not of a search.
    """
    population = state.population
    enough = max(_FEWEST, _ENOUGH * population.size)
    if state.stage is not Stage.SEARCH or population.evaluated < enough:
        return None
    return state.search.preview(*population.members())


def make_next(state: State, n: int, propose: _Propose) -> None:
    """Make the next n candidates of those that remain, each for the generation that needs it.

    propose: makes proposals from samples z (m, d) of a search.
    """
    _draw_ahead(state, n, propose)
    state.population.make_proposals(n)


def _draw_ahead(state: State, n: int, propose: _Propose) -> None:
    """Of the next n candidates, draw those anew that the present generation does not need.

    As many of them are proposals as before.  A proposer that is asked for all of a generation at
    once is left to do that.
    """
    population, proposer = state.population, state.proposer
    needed = max(0, population.size - population.evaluated - population.awaited)
    m = min(n, population.remaining) - needed
    if m <= 0 or not (proposer is None or proposer.singly):
        return
    search = previewed(state)
    if search is None:
        return
    population.make_proposals(needed)
    x, z = search.sample(m, state.rng)  # (m, d)
    proposed = population.proposed(needed, m)
    if proposed.any():
        x[proposed], z[proposed] = propose(z[proposed], search, state.rng)
    population.replace(needed, x, z, proposed)
