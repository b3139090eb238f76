"""Points that satisfy constraints: nothing else is rendered."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.mixed import Axes
from fide_plugins.space import Space
from fide_plugins.space.constraints import (
    Constraints,
    constraints_not_stored,
    constraints_of,
)
from fide_plugins.types import Float64, Mask

_ROUNDS = 200  # in which invalid samples are drawn again
_REDRAWN = 20  # in which restart candidates are drawn
_HALVINGS = 24  # of the way from a valid point to an invalid one
_TRIED = 5000  # random points at most, in search of valid ones
_BATCH, _ENOUGH = 250, 50  # of these at once, and valid ones that say where the middle is
_BATCH_OWN, _ENOUGH_OWN = 100, 1  # where a function of the user's decides, which may take long
_REPAIRED = 5000  # points by which CMA-ES looks for a valid one
_POPSIZE = 20


def validity_of(
    space: Space | None, function: object, seed: int, guess: Float64 | None, axes: Axes
) -> Validity | None:
    """Which points a run may render; arguments as of `FIDE`, axes: of the cube.  None: all.

    Raises OptionError (a ValueError), naming the constraints, if the guess (d,) is not valid.
    """
    constraints = constraints_of(space, function)
    if constraints is None:
        return None
    validity = Validity(constraints, axes, seed)
    if guess is not None and not validity.allows(guess):
        raise OptionError(
            f"x0 is not valid: it violates {constraints.explain(guess)}; give a valid one, or "
            "leave it out: then the search begins at a valid point that it finds"
        )
    return validity


class Validity:
    """Which points of the cube may be rendered.

    seed: of the search for valid points, which draws from no other generator.
    """

    def __init__(self, constraints: Constraints, axes: Axes, seed: int) -> None:
        self._constraints, self._place, self._seed = constraints, axes.clipped, seed
        own = constraints.function is not None  # then fewer points are tried, see `start`
        self._batch, self._enough = (_BATCH_OWN, _ENOUGH_OWN) if own else (_BATCH, _ENOUGH)
        self.is_known = constraints.function is not constraints_not_stored
        """Whether the constraints can be computed; not before a user's function is given again."""
        self.checked = self.rejected = 0
        """Candidates that were checked, and those that were not valid."""

    @property
    def share_rejected(self) -> float:
        """Share of the candidates that were not valid, in [0, 1]."""
        return self.rejected / max(1, self.checked)

    def of(self, X: Float64) -> Mask:
        """Which points X (n, d) are valid, (n,)."""
        return self._constraints(X) <= 0.0

    def allows(self, x: Float64) -> bool:
        """Whether x (d,) may be valid, as far as the constraints are known."""
        return not self.is_known or bool(self.of(x[None])[0])

    def _count(self, X: Float64) -> Mask:
        """As `of`, of candidates."""
        valid = self.of(X)
        self.checked += len(X)
        self.rejected += int((~valid).sum())
        return valid

    def sample(
        self, draw: Callable[[int], tuple[Float64, Float64]], n: int
    ) -> tuple[Float64, Float64, Mask]:
        """Points and samples, (n, d) each, as `draw` gives them, drawn again where invalid.

        Also which are still invalid, (n,).
        """
        x, z = draw(n)
        invalid = ~self._count(x)
        for _ in range(_ROUNDS - 1):
            if not invalid.any():
                break
            x[invalid], z[invalid] = draw(int(invalid.sum()))
            invalid[invalid] = ~self._count(x[invalid])
        return x, z, invalid

    def moved_back(self, x: Float64, anchors: Float64, other: Float64) -> Float64:
        """Points x (n, d), invalid ones moved back towards anchors (n, d), as far as is needed.

        other: (d,), a valid point in place of anchors that are not valid.
        """
        which = np.flatnonzero(~self._count(x))
        if not len(which):
            return x
        anchors = np.where(self.of(anchors)[:, None], anchors, other)
        x, ends, anchors = x.copy(), x[which], anchors[which]
        good, bad = np.zeros((len(which), 1)), np.ones((len(which), 1))
        for _ in range(_HALVINGS):
            middle = (good + bad) / 2
            valid = self.of(self._place(anchors + middle * (ends - anchors)))[:, None]
            good, bad = np.where(valid, middle, good), np.where(valid, bad, middle)
        x[which] = np.where(good > 0, self._place(anchors + good * (ends - anchors)), anchors)
        return x

    def redrawn(self, draw: Callable[[], Float64], has_more: bool, fallback: Float64) -> Float64:
        """Valid points of what `draw` gives, (m, d), m >= 1.

        has_more: whether it gives others each time; then there are as many as of the first call, if
            they can be found.  fallback: (d,), a valid point where there is none.
        """
        first = draw()
        found = first[self._count(first)]
        for _ in range(_REDRAWN if has_more else 0):
            if len(found) >= len(first):
                break
            again = draw()
            found = np.concatenate([found, again[self._count(again)]])
        return found[: len(first)] if len(found) else fallback[None]

    def start(self, x: Float64, number: int) -> Float64:
        """Where search `number` begins: at x (d,), or else at a valid point that is found.

        A function of the user's is called once if x is valid, or else for 100 random points, and
        for 100 more as long as none is valid, up to 5,000; then for up to 5,000 of CMA-ES.

        Raises OptionError (a ValueError) if no valid point is found.
        """
        if self.allows(x):
            return x
        rng = np.random.default_rng((self._seed, 2, number))
        tried = np.empty((0, len(x)))
        violations = np.empty(0)
        while len(tried) < _TRIED and (violations <= 0).sum() < self._enough:
            batch = self._place(rng.random((self._batch, len(x))))
            tried = np.concatenate([tried, batch])
            violations = np.concatenate([violations, self._constraints(batch)])
        valid = tried[violations <= 0]
        if not len(valid):
            return self._repaired(tried, violations, rng)
        middle = valid.mean(axis=0) if number <= 1 else x
        found: Float64 = valid[np.linalg.norm(valid - middle, axis=1).argmin()]
        return found

    def _repaired(self, tried: Float64, violations: Float64, rng: np.random.Generator) -> Float64:
        """A valid point that CMA-ES finds from the best of those tried (n, d)."""
        best = tried[violations.argmin()]
        search = CMAES(best, 0.1, _POPSIZE)
        for _ in range(_REPAIRED // _POPSIZE):
            z = search.sample(_POPSIZE, rng)
            x = self._place(z)
            losses = self._constraints(x)
            if losses.min() <= 0:
                found: Float64 = x[losses.argmin()]
                return found
            search.tell(z, losses + np.linalg.norm(z - x, axis=1), np.zeros(_POPSIZE, bool))
        raise OptionError(
            f"no valid point was found: of {len(tried):,} random ones none is valid, and the best "
            f"violates {self._constraints.explain(best)}; loosen that, widen the ranges of the "
            "parameters, or give a valid x0"
        )
