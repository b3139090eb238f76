"""A candidate of the next generation for a replica, see `fide_plugins.preview`.

Unlike there, nothing changes: the proposer, too, is updated in a copy (line 8 of Algorithm 1). All
of it is updated again when all results are here.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.fide import FIDE
from fide_plugins.population import Candidate
from fide_plugins.population.training_sample import columns
from fide_plugins.preview import previewed
from fide_plugins.proposers import Proposer

__all__ = ["preview_candidate"]


def preview_candidate(optimizer: FIDE, rng: np.random.Generator) -> Candidate | None:
    """Draw one candidate, from the search and the proposer as they would be updated now.

    None where too few results of the generation are known, or it is not of a search.
    Changes nothing.  A network is not trained for this: it proposes as it is.
    """
    state, search = optimizer.state, previewed(optimizer.state)
    if search is None:
        return None
    proposer = _proposer(optimizer)
    x, z = search.sample(1, rng)  # (1, d)
    index, proposed = state.population.drawn, False
    if proposer is not None and proposer.ready and rng.random() < state.gate.proposed:
        v, target = search.stretched(z), optimizer.target_tokens
        made = proposer.propose(v, target, search.mean, search.std, rng)
        x, proposed = search.place_proposals(made, z), True
        z = search.near(x)
    return Candidate(index, x[0], z[0], proposed=proposed, off_distribution=True)


def _proposer(optimizer: FIDE) -> Proposer | None:
    state = optimizer.state
    if state.proposer is None or not state.samples:
        return state.proposer
    return state.proposer.preview(*columns(state.samples), state.search.std)
