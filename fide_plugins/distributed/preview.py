"""A candidate of the next generation, while results of the present one are still pending.

Who asks when all candidates of a generation are pending has more workers than candidates are left.
Most results are known by then.  So the optimizer is updated with these (lines 8 and 10 of Algorithm
1), as if they were all there will be, and a candidate is drawn from the result.  The update is
thrown away: it is made again when all results are here.  The candidate is much nearer to the next
generation than to the present one, and counts in the next one as late.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.fide import FIDE
from fide_plugins.population import Candidate
from fide_plugins.proposers import Proposer
from fide_plugins.proposers.training_sample import columns
from fide_plugins.search.moves.policy import Stage

__all__ = ["preview_candidate"]

_ENOUGH = 1 / 2  # of the results of a generation
_FEWEST = 4  # results; no generation has fewer


def preview_candidate(optimizer: FIDE, rng: np.random.Generator) -> Candidate | None:
    """Draw one candidate, from the search and the proposer as they would be updated now.

    None where too few results of the generation are known, or it is not of a search.
    Changes nothing.  A network is not trained for this: it proposes as it is.
    """
    state = optimizer.state
    population = state.population
    enough = max(_FEWEST, _ENOUGH * population.size)
    if state.stage is not Stage.SEARCH or population.evaluated < enough:
        return None
    descent, proposer = state.descent.preview(*population.members()), _proposer(optimizer)
    x, z = descent.sample(1, rng)  # (1, d)
    proposed, maker = False, 0
    if proposer is not None and proposer.ready and rng.random() < state.gate.proposed:
        v, target = descent.rendered(z), optimizer.target_tokens
        made = proposer.proposals(v, target, descent.mean, descent.std, rng)
        x, proposed, maker = descent.place_proposals(made.x), True, int(made.makers[0])
        z = descent.near(x)
    return Candidate(population.drawn, x[0], z[0], proposed, late=True, maker=maker)


def _proposer(optimizer: FIDE) -> Proposer | None:
    state = optimizer.state
    if state.proposer is None or not state.samples:
        return state.proposer
    return state.proposer.preview(*columns(state.samples), state.descent.std)
