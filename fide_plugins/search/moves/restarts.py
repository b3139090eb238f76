"""A search from a random place, and one closely around the incumbent."""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import Known, Move, Start
from fide_plugins.types import Float64

__all__ = ["BeginAnew", "Refine"]


_REACH = 3.0  # standard deviations
_WIDTH = 0.6  # of sigma0, around the best of the random places
_MOST_DOUBLINGS = 6


class BeginAnew(Move):
    """Random places, and the distribution around the best of them.

    A new search, from a random place.

    Where images guide the search, the best of some random places is where it begins. By losses only
    it is CMA-ES with two kinds of restarts in turn (after BIPOP; Hansen 2009, "Benchmarking a
    BI-population CMA-ES on the BBOB-2009 function testbed"): populations that double, and small
    ones with narrow beginnings.

    Random places are uniform within three standard deviations of where the first search began,
    which is all of the unit cube unless the user said that the answer is nearby.  Periodic
    parameters have no walls.
    """

    name = "begin anew"
    from_incumbent = False
    has_goal = False

    def possible(self, known: Known) -> bool:
        """Return True: it needs nothing."""
        return True

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Draw n random places, (n, d)."""
        low, high = known.x0 - _REACH * known.sigma0, known.x0 + _REACH * known.sigma0
        clipped = np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)
        if known.axes.periodic is None:
            return rng.uniform(*clipped, (n, known.dim))
        around = np.maximum(low, known.x0 - 0.5), np.minimum(high, known.x0 + 0.5)
        low, high = np.where(known.axes.periodic, around, clipped)
        return known.axes.inside(rng.uniform(low, high, (n, known.dim)))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin around one of them."""
        return Start(x, _WIDTH * known.sigma0)

    def begin_without_images(self, known: Known, number: int, rng: np.random.Generator) -> Start:
        """Begin a search by losses only, the `number`-th, from 1.

        Odd ones double the population; even ones have the first population and a narrow beginning,
        and may become as wide as the first search, since the answer may be far away.
        """
        mean = self.draw(known, 1, rng)[0]
        if number % 2:
            return Start(mean, known.sigma0, 2 ** min((number + 1) // 2, _MOST_DOUBLINGS))
        widest = 10.0 ** (2.0 * rng.random())
        return Start(mean, known.sigma0 / widest, widest=widest)


class Coarsen(Move):
    """Around the incumbent, coarse first: blurred, it need not be an optimum."""

    name = "coarsen"

    def possible(self, known: Known) -> bool:
        """Whether searches that begin coarse are useful here."""
        return known.blurs

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Neighbors (n, d) of the incumbent."""
        x = known.copies(n)
        return known.axes.inside(x + _AROUND * known.sigma0 * rng.standard_normal(x.shape))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin at one of them."""
        return Start(x, _AROUND * known.sigma0)


_AROUND = 1 / 2  # of sigma0
_NARROW = 1 / 30  # of sigma0
_PATIENCE = 3  # times that of other searches


class Refine(Move):
    """A narrow search around the incumbent, once for each.

    The incumbent itself, searched closely: it may not have been at the end of its search.

    A search is over soon, so that the next move can begin, and what it found is mostly not as good
    as it could be. This move goes on with more patience and a narrow distribution, once an optimum
    has been left in vain, or at once where a hypothesis has led to the right place. It ends where
    the loss hardly falls any more (`termination.has_stalled`, with three times the patience), or
    where the distribution is as narrow as images can tell; where hypotheses of a learned model
    wait, as narrow as that with which other searches end.
    """

    name = "refine"
    has_goal = False  # it begins behind the loss of the incumbent, and needs time to come back

    def possible(self, known: Known) -> bool:
        """Whether the incumbent was left in vain, and was not refined yet."""
        optimum = known.optima.of(known.here)
        return optimum is not None and optimum.failures > 0 and not optimum.refined

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Neighbors (n, d) of the incumbent."""
        x = known.copies(n)
        return known.axes.inside(x + _NARROW * known.sigma0 * rng.standard_normal(x.shape))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin at the incumbent."""
        width = _NARROW * known.sigma0
        return Start(known.here.x, width, patience=_PATIENCE, to_the_end=True)

    def note_begun(self, known: Known, x: Float64) -> None:
        """Do not refine this optimum again."""
        optimum = known.optima.of(known.here)
        if optimum is not None:
            optimum.refined = True
