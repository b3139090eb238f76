"""What a learned model leaves open, drawn again around the best so far.

A hypothesis is rarely right in everything, and its render is judged by what is wrong in it: the
right hand on an arm that is two pixels off is no better than the wrong one.  After a search the arm
is where it should be, and renders say which hand is right.  So restart candidates are copies of the
incumbent, with parameters of hypotheses where these differ from it: half of them in a single
parameter, spread over what hypotheses that agree with the incumbent elsewhere have there, and the
others in several at once, all of one hypothesis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.search.moves.hypotheses import Hypotheses
from fide_plugins.types import Float64, Indices

__all__ = ["Resample"]

_AGREE = 0.05  # of the unit cube: the same in a parameter
_NEAREST = 0.25  # of all hypotheses: those that agree with the incumbent elsewhere
_OPEN = 0.25  # of these, at least, differ from the incumbent in a parameter that is open
_WIDE, _NARROW = 1 / 3, 1 / 16  # of sigma0, in the parameters that were drawn, in all others


class Resample(Move):
    """Parameters of hypotheses in copies of the incumbent."""

    name = "resample"
    prior_gain = 0.5

    def __init__(self, hypotheses: Hypotheses) -> None:
        self._hypotheses = hypotheses

    def possible(self, known: Known) -> bool:
        """Whether there are hypotheses that leave anything open, and no blocks are exchangeable."""
        if not self._hypotheses.available or known.exchangeability.blocks is not None:
            return False
        return len(self._open(known)) > 0

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent; every second one differs in a single parameter."""
        x, others = known.copies(n), self._hypotheses.x
        opened = self._open(known)
        if not opened:
            return x
        singles = rng.permutation(np.arange((n + 1) // 2))
        for i, row in enumerate(x[::2]):
            axes, values = opened[singles[i] % len(opened)]
            strata = -(-len(singles) // len(opened))  # draws of this parameter, one from each
            quantile = (singles[i] // len(opened) + rng.random()) / strata
            row[axes] = values[min(int(quantile * len(values)), len(values) - 1)]
        for row in x[1::2]:
            other = others[rng.integers(len(others))]
            some = rng.random(len(opened)) < 0.5
            some[rng.choice(len(opened), min(2, len(opened)), replace=False)] = True
            for axes, _ in (one for one, taken in zip(opened, some, strict=True) if taken):
                row[axes] = other[axes]
        return x

    def _open(self, known: Known) -> list[tuple[Indices, Float64]]:
        """Parameters that are open: axes, and what (m, axes) hypotheses have there, sorted."""
        here, x = known.here.x, self._hypotheses.x
        apart = known.axes.difference(x, here)
        parameters = known.axes.axes_of
        agree = np.column_stack([apart[:, axes].max(axis=1) <= _AGREE for axes in parameters])
        opened = []
        for i, axes in enumerate(parameters):
            elsewhere = agree.sum(axis=1) - agree[:, i]
            nearest = np.argsort(-elsewhere, kind="stable")[: max(1, int(_NEAREST * len(x)))]
            differ = nearest[~agree[nearest, i]]
            if len(differ) >= _OPEN * len(nearest):
                values = x[differ][:, axes]
                opened.append((axes, values[np.lexsort(values.T[::-1])]))
        return opened

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wide in what was drawn, narrow in what was found before."""
        start = known.start_at(x, wide=_WIDE, narrow=_NARROW)
        return replace(start, brisk_above=self._hypotheses.brisk_above)
