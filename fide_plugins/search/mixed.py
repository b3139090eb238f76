"""Candidates of a search over a space with integers, choices and periodic parameters.

    z ~ N(m, Sigma)      drawn by the search, which learns from it
    v = m + A (z - m)    stretched on axes with cells, see `margin`
    x                    the point of the cube that is rendered: an integer or a choice in the
                         middle of its cell, all other coordinates reflected or wrapped (`boundary`)

The cells at either end of an axis reach to infinity, so that nothing is reflected there.  A
candidate that comes from elsewhere, at x, has the z that is closest to the mean.

Without integers, choices and periodic parameters all of this is `boundary`, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from fide_plugins.search import boundary
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.margin import correct_choice, correct_steps, default_alpha
from fide_plugins.types import Float64, Mask

__all__ = ["AxisLayout", "Mixed", "periodic_axes"]

_WIDE = 0.3  # standard deviation on an axis with cells where nothing is known; that of U(0, 1)
_USUAL = 1 / 6  # that on other axes


class AxisLayout(Protocol):
    """What is discrete and periodic in the cube; `fide_plugins.space.layout.Layout` is one."""

    @property
    def dim(self) -> int:
        """Number of axes d."""

    @property
    def periodic(self) -> Mask:
        """(d,), axes that wrap around."""

    @property
    def choices(self) -> Sequence[slice]:
        """Blocks of axes of which the largest coordinate decides."""

    @property
    def discrete(self) -> Mask:
        """(d,), axes on which many points stand for one value."""

    def snap(self, X: Float64) -> Float64:
        """Put discrete coordinates of (n, d), which may leave the cube, in the middle of cells."""

    def cells(self, x: Float64) -> tuple[Float64, Float64]:
        """Where the cell of each coordinate of x (d,) begins and ends; -inf, inf for none."""


def periodic_axes(layout: AxisLayout | None) -> Mask | None:
    """(d,), axes that wrap around; None where none does."""
    return None if layout is None or not layout.periodic.any() else layout.periodic


class Mixed:
    """The maps between z and x, and the margin.

    layout: None where every parameter is a number with walls.
    """

    def __init__(self, layout: AxisLayout | None) -> None:
        self.layout = layout
        self._periodic = periodic_axes(layout)
        self._discrete = None if layout is None or not layout.discrete.any() else layout.discrete
        self.A: Float64 = np.ones(0 if layout is None else layout.dim)

    def widened(self, std: Float64) -> Float64:
        """Standard deviations (d,) of a search that knows nothing: at least 0.3 on discrete axes.

        With the usual 1/6 the integers at the ends would hardly be tried.  Who gives less knows
        more, and gets as much less than 0.3: around a good guess few integers and choices change.
        """
        if self._discrete is None:
            return std
        widened = np.maximum(std, _WIDE * np.minimum(1.0, std / _USUAL))
        return np.where(self._discrete, widened, std)

    @property
    def stretch(self) -> Float64 | float:
        """A (d,), or 1 where nothing is discrete."""
        return 1.0 if self._discrete is None else self.A

    def stretched(self, z: Float64, mean: Float64) -> Float64:
        """V (n, d) of candidates z (n, d)."""
        return z if self._discrete is None else mean + self.A * (z - mean)

    def into(self, z: Float64, mean: Float64) -> Float64:
        """Points x (n, d) that candidates z (n, d) stand for."""
        return self.reflected(self.stretched(z, mean))

    def reflected(self, v: Float64) -> Float64:
        """Points x (n, d) of the cube for v (n, d), reflected at its walls, or wrapped."""
        if self._discrete is not None and self.layout is not None:
            v = self.layout.snap(v)
        return boundary.into(v, self._periodic)

    def clipped(self, proposed: Float64) -> Float64:
        """Points x (n, d) of the cube for proposals (n, d), which are clipped or wrapped."""
        x = boundary.inside(proposed, self._periodic)
        return x if self._discrete is None or self.layout is None else self.layout.snap(x)

    def closest(self, x: Float64, mean: Float64) -> Float64:
        """Return the z (n, d) of points x (n, d) that is closest to the mean (d,)."""
        v = boundary.closest(x, mean, self._periodic)
        if self._discrete is None:
            return v
        return mean + (np.where(self._discrete, x, v) - mean) / self.A

    def correct(self, distribution: CMAES) -> None:
        """Move the mean, and change A, so that no value is given up; see `margin`."""
        if self._discrete is None or self.layout is None:
            return
        alpha = default_alpha(distribution.dim, distribution.popsize)
        lower, upper = self.layout.cells(distribution.mean)
        std = np.maximum(distribution.std, np.finfo(np.float64).tiny)
        mean, stretched = correct_steps(distribution.mean, self.A * std, lower, upper, alpha)
        for block in self.layout.choices:
            cov = distribution.sigma**2 * distribution.C[block, block]
            mean[block] = correct_choice(mean[block], cov, alpha)
        self.A = np.where(self._discrete, stretched / std, 1.0)
        distribution.mean = mean

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"A": self.A}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self.A = state["A"]
