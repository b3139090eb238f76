"""A parameter group at a random place: right where nothing else is known of the scene.

Exchangeable blocks are groups. Elsewhere groups come from sensitivity samples.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Stage, Start
from fide_plugins.types import Float64, Indices

__all__ = ["RelocateGroup"]


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
