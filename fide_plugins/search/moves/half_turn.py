"""Angles that look alike: half a turn away, mirrored, or both.

Much that is turned looks nearly the same after half a turn, so that a search settles on the wrong
side. And a rotation has two descriptions by three angles, (a, b, c) and (a + 180°, -b, c + 180°)
(Diebel 2006, *Representing Attitude*, section 5): a shoulder of three joints that holds the hand
where it should be holds the elbow on the right side or on the wrong one, and no small step leads
from one to the other.

Nobody has said which parameters are angles. A joint, or a camera's azimuth, mostly has a range of
one turn or a little less, with zero in the middle: half a turn is half of the box or a little more,
and the sign changes by a reflection about the center.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.types import Float64, Indices

__all__ = ["HalfTurn"]

_LONGEST = 0.58  # half a turn in units of the box, for a range of 310 degrees
_WIDE = 1 / 4  # of sigma0, in the parameters that were turned


class HalfTurn(Move):
    """One to three neighbors, alternately turned by half a turn and mirrored."""

    name = "half turn"

    def possible(self, known: Known) -> bool:
        """Whether there is anything continuous, and no blocks are exchangeable."""
        return known.exchangeability.blocks is None and len(_continuous(known)) > 0

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with some neighbors turned."""
        angles = _continuous(known)
        x = known.copies(n)
        for row in x:
            length = int(rng.integers(1, min(3, len(angles)) + 1))
            first = int(rng.integers(0, len(angles) - length + 1))
            mirrored = 1 if length == 3 else int(rng.integers(0, 2))
            for i, axis in enumerate(angles[first : first + length]):
                if i % 2 == mirrored:
                    row[axis] = 1.0 - row[axis]
                else:
                    row[axis] += (1.0 if row[axis] < 0.5 else -1.0) * _half(known, axis, rng)
        return known.axes.inside(x)

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wider in what was turned: the ranges of the angles are a guess."""
        return known.start_at(x, wide=_WIDE)


def _continuous(known: Known) -> Indices:
    """Axes that are neither an integer's nor a choice's."""
    return np.flatnonzero(~np.broadcast_to(known.values.discrete, known.dim))


def _half(known: Known, axis: int, rng: np.random.Generator) -> float:
    """Half a turn in units of the box: just so where the parameter is periodic, else a guess."""
    periodic = known.axes.periodic is not None and known.axes.periodic[axis]
    return 0.5 if periodic else float(rng.uniform(0.5, _LONGEST))
