"""A segment of neighboring parameters at a random place, where nothing says what belongs together.

That is for scenes in which parameters act on one another: the joints of an arm all move the hand.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.types import Float64, Indices

__all__ = ["RelocateSegment", "segment"]


class RelocateSegment(Move):
    """Segments of neighboring parameters, of any length up to half of all."""

    name = "relocate segment"

    def possible(self, known: Known) -> bool:
        """Whether no exchangeable blocks say what belongs together."""
        return known.dim > 1 and known.exchangeability.blocks is None

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with one segment uniform in the unit cube."""
        x = known.copies(n)
        for row in x:
            chosen = known.axes.together(segment(known.dim, rng))
            row[chosen] = rng.random(len(chosen))
        return x

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wide in the segment, narrow elsewhere."""
        return known.start_at(x)


def segment(dim: int, rng: np.random.Generator) -> Indices:
    """Draw neighboring parameters: a length log-uniform in [1, d / 2], any place."""
    length = int(np.exp(rng.uniform(0.0, np.log(dim // 2 + 1))))
    start = int(rng.integers(0, dim - length + 1))
    return np.arange(start, start + length)
