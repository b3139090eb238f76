"""The incumbent itself, searched closely: it may not have been at the end of its search.

A search is over soon, so that the next move can begin, and what it found is mostly not as good as
it could be. This move goes on with more patience and a narrow distribution, once an optimum has
been left in vain, or at once where a hypothesis has led to the right place. It ends where the loss
hardly falls any more (`termination.has_stalled`, with three times the patience), or where the
distribution is as narrow as images can tell; where hypotheses of a learned model wait, as narrow as
that with which other searches end.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.types import Float64

__all__ = ["Refine"]

_WIDTH = 1 / 30  # of sigma0
_PATIENCE = 3  # times that of other searches


class Refine(Move):
    """A narrow search around the incumbent, once for each."""

    name = "refine"
    has_goal = False  # it begins behind the loss of the incumbent, and needs time to come back

    def possible(self, known: Known) -> bool:
        """Whether the incumbent was left in vain, and was not refined yet."""
        optimum = known.optima.of(known.here)
        return optimum is not None and optimum.failures > 0 and not optimum.refined

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Neighbors (n, d) of the incumbent."""
        x = known.copies(n)
        return known.axes.inside(x + _WIDTH * known.sigma0 * rng.standard_normal(x.shape))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin at the incumbent."""
        width = _WIDTH * known.sigma0
        return Start(known.here.x, width, patience=_PATIENCE, to_the_end=True)

    def note_begun(self, known: Known, x: Float64) -> None:
        """Do not refine this optimum again."""
        optimum = known.optima.of(known.here)
        if optimum is not None:
            optimum.refined = True
