"""Walls of the unit cube; integers, choices and periodic parameters.

A candidate z ~ N(m, Sigma) stands for v = m + A (z - m), stretched on axes with cells, and for the
point x of the cube that is rendered.  Where there are none of these, x is `into(z)`.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from scipy.special import ndtr, ndtri

from fide_plugins.runtime.schema import Schema, Sides, Stateful, array
from fide_plugins.search.cma_es import CMAES
from fide_plugins.space.layout import Layout
from fide_plugins.types import Float64, Indices, Mask


def into(z: Float64, periodic: Mask | None = None) -> Float64:
    """Points of the unit cube that candidates `z` (..., d) stand for.

    They are reflected at its walls: the search optimizes the even, periodic continuation of the
    loss, and learns from z itself, so every step it is told is one it drew.  (Telling the repaired
    point would shrink the covariance across a nearby wall.)  Periodic axes wrap around.
    """
    period = np.mod(z, 2.0)  # in [0, 2]
    x: Float64 = np.minimum(period, 2.0 - period)
    if periodic is not None:
        x = np.where(periodic & ((z < 0.0) | (z > 1.0)), np.mod(z, 1.0), x)
    return np.clip(x, 0.0, 1.0)


def distance(x: Float64, y: Float64, periodic: Mask | None = None) -> Float64:
    """Distances of coordinates x and y (..., d) of the cube, the shorter way where periodic."""
    apart: Float64 = np.abs(x - y)
    return apart if periodic is None else np.where(periodic, np.minimum(apart, 1.0 - apart), apart)


def shorter(apart: Float64, periodic: Mask | None) -> Float64:
    """Signed differences (..., d) of coordinates, the shorter way around where periodic."""
    return apart if periodic is None else np.where(periodic, (apart + 0.5) % 1.0 - 0.5, apart)


def closest(x: Float64, mean: Float64, periodic: Mask | None = None) -> Float64:
    """Return the z (n, d) with into(z) = x (n, d) that is closest to `mean` (d,)."""
    turn = 2.0 * np.round((mean - x) / 2.0)
    mirrored = -x + 2.0 * np.round((mean + x) / 2.0)
    direct = x + turn
    z: Float64 = np.where(np.abs(mirrored - mean) < np.abs(direct - mean), mirrored, direct)
    if periodic is not None:
        z = np.where(periodic, x + np.round(mean - x), z)
    return z


_SMALLEST, _LARGEST = 1e-10, 0.5 - 1e-10  # probabilities of one side
_CENTER = 0.5  # of the means of a block


def correct_steps(
    m: Float64, s: Float64, lower: Float64, upper: Float64, alpha: float
) -> tuple[Float64, Float64]:
    """Mean and standard deviations, (d,) each, that leave their cells with probability alpha.

    CMA-ES with margin (Hamano et al. 2022, arXiv:2205.13482).  Of a first or last cell the mean is
    not farther than q(1 - alpha) s from the only edge; of an inner one both sides get at least
    alpha / 2, and m and s follow from the two of the sides.

    m, s: (d,), before.  lower, upper: (d,), the cells of m; both endless where an axis has none.
    """
    mean, std = m.copy(), s.copy()
    edge = np.isfinite(lower) ^ np.isfinite(upper)
    only, reach = np.where(np.isfinite(lower), lower, upper), ndtri(1 - alpha) * s
    mean[edge] = np.clip(m, only - reach, only + reach)[edge]
    inner = np.isfinite(lower) & np.isfinite(upper)
    mean[inner], std[inner] = _with_both_sides(
        m[inner], s[inner], lower[inner], upper[inner], alpha
    )
    return mean, std


def _with_both_sides(
    m: Float64, s: Float64, lower: Float64, upper: Float64, alpha: float
) -> tuple[Float64, Float64]:
    """Means and standard deviations that leave [lower, upper] to either side by alpha / 2."""
    below, above = ndtr((lower - m) / s), ndtr((m - upper) / s)
    enough = (below >= alpha / 2) & (above >= alpha / 2)
    inside = 1 - below - above
    below, above = np.maximum(below, alpha / 2), np.maximum(above, alpha / 2)
    excess = below + above + inside - 1
    share = excess / (below + inside + above - 3 * alpha / 2)
    below = np.clip(below - share * (below - alpha / 2), _SMALLEST, _LARGEST)
    above = np.clip(above - share * (above - alpha / 2), _SMALLEST, _LARGEST)
    left, right = ndtri(1 - below), ndtri(1 - above)  # m - lower = left s, upper - m = right s
    mean = (lower * right + upper * left) / (left + right)
    std = (upper - lower) / (left + right)
    return np.where(enough, m, mean), np.where(enough, s, std)


def correct_choice(m: Float64, cov: Float64, alpha: float) -> Float64:
    """Means (K,) of a block of which each value has about alpha at least against the best.

    Between the value b of the largest mean and another value j, z_b - z_j decides at zero: an axis
    with one edge.  Only differences count, so the means are centered.

    m: (K,), before.  cov: (K, K), covariance of the coordinates as they are rendered.
    """
    b = int(np.argmax(m))
    variance = np.diag(cov) + cov[b, b] - 2 * cov[b]  # of z_j - z_b
    reach = ndtri(1 - alpha) * np.sqrt(np.maximum(variance, 0.0))
    mean: Float64 = np.maximum(m, m[b] - reach)
    centered: Float64 = mean + (_CENTER - mean.mean())
    return centered


_WIDE = 0.3  # standard deviation on an axis with cells where nothing is known; that of U(0, 1)
_USUAL = 1 / 6  # that on other axes


class Axes:
    """The axes of the cube: which are one parameter, wrap around, or have cells.

    A choice of n > 2 values has n axes, of which the largest coordinate decides: moved alone, they
    mostly change nothing, so moves move them together.

    dim: d.  layout: what is discrete or periodic; None: nothing.
    discrete, periodic: (d,), axes with cells, and those that wrap around; None: there are none.
    parameter_of: (d,), number of the parameter of each axis, from 0.
    axes_of: axes of each parameter.  continuous: those of no integer and no choice.
    """

    def __init__(self, dim: int, layout: Layout | None = None) -> None:
        self.dim, self.layout = dim, layout
        self.periodic = None if layout is None else layout.wrapped
        self.discrete: Mask | None = None
        if layout is not None and layout.discrete.any():
            self.discrete = layout.discrete
        self.continuous: Indices = np.arange(dim)
        if self.discrete is not None:
            self.continuous = np.flatnonzero(~self.discrete)
        first: Indices = np.arange(dim)  # axis of the parameter of each axis
        for block in () if layout is None else layout.choices:
            first[block] = block.start
        self.parameter_of: Indices = np.unique(first, return_inverse=True)[1]
        numbers = range(self.parameter_of[-1] + 1)
        self.axes_of = [np.flatnonzero(self.parameter_of == i) for i in numbers]

    def together(self, chosen: Indices) -> Indices:
        """All axes of the parameters that these axes are of."""
        if len(self.axes_of) == self.dim:
            return chosen
        return np.flatnonzero(np.isin(self.parameter_of, self.parameter_of[chosen]))

    def difference(self, x: Float64, y: Float64, which: Indices | None = None) -> Float64:
        """Differences of coordinates x and y (..., d), the shorter way around; at least 0.

        which: axes (..., m) of coordinates x and y (..., m); None: all.
        """
        periodic = self.periodic
        return distance(x, y, periodic if periodic is None or which is None else periodic[which])

    def inside(self, x: Float64) -> Float64:
        """Points (..., d) that somebody wants, in the cube: wrapped where periodic, or clipped."""
        if self.periodic is not None:
            x = np.where(self.periodic, into(x, self.periodic), x)
        return np.clip(x, 0.0, 1.0)

    def clipped(self, x: Float64) -> Float64:
        """The same points (n, d) as they are rendered: integers and choices in their cells."""
        x = self.inside(x)
        return x if self.discrete is None or self.layout is None else self.layout.snap(x)

    def reflected(self, v: Float64) -> Float64:
        """Points (n, d) of the cube for v (n, d), reflected at its walls, or wrapped."""
        cells = None if self.discrete is None else self.layout
        return into(v if cells is None else cells.snap(v), self.periodic)

    def widened(self, std: Float64) -> Float64:
        """Standard deviations (d,) of a search that knows nothing: at least 0.3 on discrete axes.

        With the usual 1/6 the integers at the ends would hardly be tried.
        """
        if self.discrete is None:
            return std
        widened = np.maximum(std, _WIDE * np.minimum(1.0, std / _USUAL))
        return np.where(self.discrete, widened, std)

    def correct(self, distribution: CMAES, stretch: Float64) -> Float64:
        """Move the mean so that no value is given up; returns how A (d,) changes for that."""
        assert self.layout is not None
        alpha = 1 / (distribution.dim * distribution.popsize)
        lower, upper = self.layout.cells(distribution.mean)
        std = np.maximum(distribution.std, np.finfo(np.float64).tiny)
        mean, stretched = correct_steps(distribution.mean, stretch * std, lower, upper, alpha)
        for block in self.layout.choices:
            cov = distribution.sigma**2 * distribution.C[block, block]
            mean[block] = correct_choice(mean[block], cov, alpha)
        distribution.mean = mean
        return np.where(self.layout.discrete, stretched / std, 1.0)


# -- integers and choices --------------------------------------------------------------------------

_REMEMBERED = 200  # combinations
_CELLS_AWAY = (*range(2, 9), *(2**i for i in range(4, 10)))
_BEYOND = 1e-9  # beyond an edge, and in the next cell


class Values(Stateful):
    """Which other values integers and choices can have, and which combinations were searched.

    axes: those of one parameter, and what is discrete; None: nothing is.
    discrete: (d,), axes on which many points stand for one value.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {"searched": array("m", "discrete", low=0.0, high=1.0)}

    def __init__(self, axes: Axes | None = None) -> None:
        self._axes = axes
        self.discrete: Mask = np.zeros(1, bool)
        if axes is not None and axes.discrete is not None:
            self.discrete = axes.discrete
        self._searched = np.empty((0, int(self.discrete.sum())))  # the oldest first

    def others(self, x: Float64) -> Float64:
        """Copies (n, d) of a rendered point x (d,), each with another value of one parameter.

        All values of a choice; of an integer those up to 8 cells away, and 16, 32, ... 512.
        """
        if self._axes is None or self._axes.layout is None:
            return np.empty((0, len(x)))
        parameters = [axes for axes in self._axes.axes_of if self.discrete[axes[0]]]
        rows = [row for axes in parameters for row in self._changed(x, axes)]
        every = self._axes.layout.snap(np.array(rows).reshape(-1, len(x)))
        every = every[(every != x).any(axis=1)]
        distinct: Float64 = every[np.sort(np.unique(every, axis=0, return_index=True)[1])]
        return distinct

    def _changed(self, x: Float64, axes: Indices) -> Float64:
        """Copies (m, d) of x with coordinates of one parameter changed, x itself among them."""
        if len(axes) > 1:
            rows = np.tile(x, (len(axes), 1))
            rows[:, axes] = np.eye(len(axes))
            return rows
        assert self._axes is not None and self._axes.layout is not None
        (i,) = axes
        edges = [float(edge[i]) for edge in self._axes.layout.cells(x) if np.isfinite(edge[i])]
        values = [edge + np.copysign(_BEYOND, edge - x[i]) for edge in edges]
        width = 2 * min((abs(edge - x[i]) for edge in edges), default=1.0)
        values += [v for n in _CELLS_AWAY for v in (x[i] - n * width, x[i] + n * width)]
        values = [v for v in values if 0 <= v <= 1]
        rows = np.tile(x, (len(values), 1))
        rows[:, i] = values
        return rows

    def searches(self, X: Float64) -> Indices:
        """How often a search began at the values of each point (n, d), (n,)."""
        same = X[:, None, self.discrete] == self._searched
        return np.asarray(same.all(axis=2).sum(axis=1), np.intp)

    def note(self, x: Float64) -> None:
        """Note that a search begins at the values of x (d,)."""
        self._searched = np.vstack([self._searched, x[self.discrete]])[-_REMEMBERED:]

    def _sides(self) -> Sides:
        return {"discrete": int(self.discrete.sum())}
