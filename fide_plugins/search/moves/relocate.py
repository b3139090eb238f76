"""A parameter group at a random place: right where nothing else is known of the scene.

Exchangeable blocks are groups. Elsewhere groups come from sensitivity samples, or are segments of
neighboring parameters, for scenes in which parameters act on one another: the joints of an arm all
move the hand.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Indices, Known, Move, Stage, Start
from fide_plugins.types import Float64

__all__ = ["RelocateGroup", "RelocateSegment", "segment"]


class RelocateGroup(Move):
    """Groups by exchangeability or sensitivity, drawn by their size."""

    name = "relocate group"

    def possible(self, known: Known) -> bool:
        """Whether there is more than one parameter."""
        return known.dim > 1

    def needs(self, known: Known) -> Stage | None:
        """Sensitivity samples, once, where blocks are not known."""
        if known.exchangeability.blocks is not None or known.sensitivity.rounds:
            return None
        return Stage.SENSITIVITY

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with one group uniform in the unit cube."""
        groups = self._groups(known)
        sizes = np.array([len(group) for group in groups])
        x = known.copies(n)
        for row, which in zip(x, rng.choice(len(groups), n, p=sizes / sizes.sum()), strict=True):
            row[groups[which]] = rng.random(sizes[which])
        return x

    def _groups(self, known: Known) -> list[Indices]:
        blocks = known.exchangeability.blocks
        if blocks is None:
            return known.sensitivity.groups
        leftovers = known.exchangeability.leftovers
        return [*blocks, *([leftovers] if len(leftovers) else [])]

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wide in the group, narrow elsewhere."""
        return known.start_at(x)


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
