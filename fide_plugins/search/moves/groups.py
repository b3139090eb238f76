"""Moves of parameter groups: one at a random place, two exchanged, one split in two.

Exchangeable blocks are groups; elsewhere groups come from sensitivity samples.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import NARROW, Known, Move, Stage, Start
from fide_plugins.types import Float64, Indices

__all__ = ["RelocateGroup", "Split", "Swap"]


class RelocateGroup(Move):
    """Groups by exchangeability or sensitivity, drawn by their size.

    A parameter group at a random place is right where nothing else is known of the scene.
    """

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


class Swap(Move):
    """Values of one block to another, and back.

    Two exchangeable blocks with their values exchanged: another order of painting.

    Only where the order of blocks shows (`Exchangeability.ordered`): elsewhere the image is the
    same.
    """

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


_SMALLEST, _LARGEST = 0.03, 0.5  # standard deviation of a difference, log-uniform


class Split(Move):
    """Donor := source + N(0, s^2), s log-uniform for each parameter.

    A redundant block becomes a copy of one that has too much to do.

    Local optima of exchangeable things have a known shape: several things of the scene stand for
    one of the target's, and one stands for several, as centers do in k-means (Qian et al. 2020,
    arXiv:2002.06694; fission and fusion, arXiv:2201.04822). So the block that is cheapest to remove
    (`scene.removal`) is put beside the one in whose region most of the error lies, with random
    differences; the search then divides the region between the two.
    """

    name = "split"
    prior_gain = 0.5

    def possible(self, known: Known) -> bool:
        """Whether there are exchangeable blocks."""
        return known.exchangeability.blocks is not None

    def needs(self, known: Known) -> Stage | None:
        """Removal costs of the incumbent."""
        return None if known.removal.known else Stage.REMOVAL

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent with one block beside another.

        The donor is drawn by exp(-rank of its removal cost), the source in proportion to the
        residual in the tokens that it owns.
        """
        blocks = known.exchangeability.blocks
        assert blocks is not None
        removal = known.removal
        rank = np.argsort(np.argsort(removal.costs, kind="stable"), kind="stable")
        cheap = np.exp(-rank.astype(np.float64))
        residual = removal.residual(known.here, known.target, known.channels) + 1e-300
        x = known.copies(n)
        spread = np.exp(rng.uniform(np.log(_SMALLEST), np.log(_LARGEST), (n, blocks.shape[1])))
        jitter = spread * rng.standard_normal((n, blocks.shape[1]))
        for row, difference in zip(x, jitter, strict=True):
            donor = rng.choice(len(blocks), p=cheap / cheap.sum())
            weight = residual.copy()
            weight[donor] = 0.0
            source = rng.choice(len(blocks), p=weight / weight.sum())
            row[blocks[donor]] = row[blocks[source]] + difference
        return known.axes.inside(x)

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wide in the donor, narrow elsewhere."""
        return known.start_at(x)
