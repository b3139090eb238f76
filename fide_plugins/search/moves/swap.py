"""Two exchangeable blocks with their values exchanged: another order of painting.

Only where the order of blocks shows (`Exchangeability.ordered`): elsewhere the image is the same.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import NARROW, Known, Move, Start
from fide_plugins.types import Float64

__all__ = ["Swap"]


class Swap(Move):
    """Values of one block to another, and back."""

    name = "swap"

    def possible(self, known: Known) -> bool:
        """Whether there are blocks whose order shows."""
        return known.exchangeability.blocks is not None and known.exchangeability.ordered

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with two blocks exchanged."""
        blocks = known.exchangeability.blocks
        assert blocks is not None
        x = known.copies(n)
        for row in x:
            a, b = blocks[rng.choice(len(blocks), 2, replace=False)]
            row[a], row[b] = row[b], row[a]
        return x

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Narrow everywhere: the values are those of a local optimum."""
        return known.start_at(x, wide=NARROW)
