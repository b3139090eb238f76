"""Moves of neighboring parameters, where nothing says what belongs together.

Of scenes in which parameters act on one another: the joints of an arm all move the hand.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.types import Float64, Indices

__all__ = ["Crossover", "HalfTurn", "RelocateSegment", "segment"]

_WIDTH = 1 / 4  # of sigma0, in the parameters from another optimum, or that were turned


class RelocateSegment(Move):
    """Segments of neighboring parameters, of any length up to half of all.

    A segment of neighboring parameters at a random place, where nothing says what belongs together.

    That is for scenes in which parameters act on one another: the joints of an arm all move the
    hand.
    """

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


class Crossover(Move):
    """A segment of the incumbent, and all else of another optimum, or the other way round.

    A segment of parameters from another local optimum.

    Several descents of one scene end in several places, each right in something else: one has the
    shoulder of an arm right, one the wrist. Their children have both (HG-means does so for
    clusters, Gribel and Vidal 2019, arXiv:1804.09813). Where blocks are exchangeable the same block
    stands for different things in two optima; `Split` is for these.
    """

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
        return known.start_at(x, wide=_WIDTH)


_LONGEST = 0.58  # half a turn in units of the box, for a range of 310 degrees


class HalfTurn(Move):
    """One to three neighbors, alternately turned by half a turn and mirrored.

    Angles that look alike: half a turn away, mirrored, or both.

    Much that is turned looks nearly the same after half a turn, so that a search settles on the
    wrong side. And a rotation has two descriptions by three angles, (a, b, c) and (a + 180°, -b, c
    + 180°) (Diebel 2006, *Representing Attitude*, section 5): a shoulder of three joints that holds
    the hand where it should be holds the elbow on the right side or on the wrong one, and no small
    step leads from one to the other.

    Nobody has said which parameters are angles. A joint, or a camera's azimuth, mostly has a range
    of one turn or a little less, with zero in the middle: half a turn is half of the box or a
    little more, and the sign changes by a reflection about the center.
    """

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
        return known.start_at(x, wide=_WIDTH)


def _continuous(known: Known) -> Indices:
    """Axes that are neither an integer's nor a choice's."""
    return np.flatnonzero(~np.broadcast_to(known.values.discrete, known.dim))


def _half(known: Known, axis: int, rng: np.random.Generator) -> float:
    """Half a turn in units of the box: just so where the parameter is periodic, else a guess."""
    periodic = known.axes.periodic is not None and known.axes.periodic[axis]
    return 0.5 if periodic else float(rng.uniform(0.5, _LONGEST))
