"""A segment of parameters from another local optimum.

Several descents of one scene end in several places, each right in something else: one has the
shoulder of an arm right, one the wrist. Their children have both (HG-means does so for clusters,
Gribel and Vidal 2019, arXiv:1804.09813). Where blocks are exchangeable the same block stands for
different things in two optima; `split` is for these.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.search.moves.relocate_segment import segment
from fide_plugins.types import Float64

__all__ = ["Crossover"]

_WIDE = 1 / 4  # of sigma0, in the parameters from elsewhere


class Crossover(Move):
    """A segment of the incumbent, and all else of another optimum, or the other way round."""

    name = "crossover"

    def possible(self, known: Known) -> bool:
        """Whether another local optimum is known, and no blocks are exchangeable."""
        return known.exchangeability.blocks is None and len(self._others(known)) > 0

    def _others(self, known: Known) -> list[Float64]:
        here = known.here.x
        every = [optimum.sample.x for optimum in known.optima.all]
        return [x for x in every if not np.array_equal(x, here)]

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with a segment, or all but a segment, of another.

        The other optimum is drawn by its rank.
        """
        others = self._others(known)
        weights = np.exp(-np.arange(len(others)) / max(1.0, len(others) / 3))
        x = known.copies(n)
        for row in x:
            other = others[rng.choice(len(others), p=weights / weights.sum())]
            chosen = known.axes.together(segment(known.dim, rng))
            if rng.random() < 0.5:
                chosen = np.setdiff1d(np.arange(known.dim), chosen)
            row[chosen] = other[chosen]
        return x

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wider in what comes from elsewhere."""
        return known.start_at(x, wide=_WIDE)
