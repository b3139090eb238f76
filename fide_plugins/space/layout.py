"""Numbers of all parameters and points of the unit cube, for many points at once.

Notation: p parameters, d axes; values V (n, p) are the numbers of `kinds`, points X (n, d).

A number v of an axis with log is t = log v, otherwise t = v; an axis with steps reaches half a step
beyond either end, so that n numbers are n equal cells:

    x = (t(v) - bottom) / length,  bottom = t(low - step / 2),  length = t(high + step / 2) - bottom
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fide_plugins.space.kinds import Float, Kind
from fide_plugins.types import Float64, Indices, Mask

_CHOSEN, _NOT_CHOSEN = 0.75, 0.25  # coordinates of a choice, in the middle of their halves


class Layout:
    """Where each parameter lies.

    dim: d, number of axes.
    slices: of the axes of each parameter; empty for a constant.
    periodic: (d,), axes that wrap around; wrapped: the same, None where none does.
    stepped: (d,), axes of which only cells matter: integers, steps, choices of two.
    choices: slices of the blocks of axes in which the largest coordinate decides.
    """

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self.count = len(kinds)
        ends = np.cumsum([0, *(kind.width for kind in kinds)]).tolist()
        self.dim: int = ends[-1]
        self.slices = [slice(a, b) for a, b in pairwise(ends)]
        single = [i for i, kind in enumerate(kinds) if kind.width == 1]
        self._one = np.array(single, np.intp)  # parameters with one axis
        self._axis = np.array([ends[i] for i in single], np.intp)  # and the axis of each
        self._many = [i for i, kind in enumerate(kinds) if kind.width > 1]
        self.choices = [self.slices[i] for i in self._many]
        self.periodic = np.zeros(self.dim, bool)
        self.periodic[self._axis] = [isinstance(k, Float) and k.periodic for k in self._of(kinds)]
        self.wrapped: Mask | None = self.periodic if self.periodic.any() else None
        scales = [kind.scale for kind in self._of(kinds)]
        columns = np.array(scales, np.float64).reshape(-1, 4).T
        self._low, self._high, self._step = (column.copy() for column in columns[:3])
        self._log = columns[3] > 0
        self._any_log, self._any_step = bool(self._log.any()), bool(self._step.any())
        self._bottom = self._scaled(self._low - self._step / 2)
        self._length = self._scaled(self._high + self._step / 2) - self._bottom
        self.stepped = np.zeros(self.dim, bool)
        self.stepped[self._axis] = self._step > 0

    def _of(self, kinds: Sequence[Kind]) -> list[Kind]:
        return [kinds[i] for i in self._one]

    @property
    def discrete(self) -> Mask:
        """(d,), axes on which many points stand for one value."""
        mask = self.stepped.copy()
        for block in self.choices:
            mask[block] = True
        return mask

    def numbers(self, X: Float64) -> Float64:
        """V (n, p) of points (n, d), also of points outside of the cube."""
        if len(self._one) == self.count == self.dim:
            return self._rounded(X)
        V = np.zeros((len(X), self.count))
        V[:, self._one] = self._rounded(X[:, self._axis])
        for i, block in zip(self._many, self.choices, strict=True):
            V[:, i] = X[:, block].argmax(axis=1)
        return V

    def points(self, V: Float64) -> Float64:
        """X (n, d) of numbers (n, p), in the middle of their cells."""
        if len(self._one) == self.count == self.dim:
            return self._placed(V)
        X = np.empty((len(V), self.dim))
        X[:, self._axis] = self._placed(V[:, self._one])
        for i, block in zip(self._many, self.choices, strict=True):
            X[:, block] = _one_hot(V[:, i].astype(np.intp), block.stop - block.start)
        return X

    def snap(self, X: Float64) -> Float64:
        """Points (n, d) that stand for the same numbers; those of continuous axes stay."""
        snapped = X.copy()
        stepped = self._step > 0
        axes = self._axis[stepped]
        snapped[:, axes] = self._placed(self._rounded(X[:, self._axis]))[:, stepped]
        for block in self.choices:
            snapped[:, block] = _one_hot(X[:, block].argmax(axis=1), block.stop - block.start)
        return snapped

    def cells(self, x: Float64) -> tuple[Float64, Float64]:
        """Where the cell begins and ends in which each coordinate of x (d,) lies; (d,) each.

        The first and last cells of an axis are endless, as are axes without cells.
        """
        lower, upper = np.full(self.dim, -np.inf), np.full(self.dim, np.inf)
        values, half = self._rounded(x[None, self._axis])[0], self._step / 2
        begins = (self._scaled(values - half) - self._bottom) / self._length
        ends = (self._scaled(values + half) - self._bottom) / self._length
        stepped = self._step > 0
        lower[self._axis] = np.where(stepped & (values > self._low), begins, -np.inf)
        upper[self._axis] = np.where(stepped & (values < self._high), ends, np.inf)
        return lower, upper

    def _scaled(self, values: Float64) -> Float64:
        """T of numbers (..., m) of the axes."""
        if not self._any_log:
            return values
        scaled = values.copy()
        scaled[..., self._log] = np.log(values[..., self._log])
        return scaled

    def _rounded(self, points: Float64) -> Float64:
        """Numbers (..., m) of coordinates (..., m): the nearest that there are."""
        inside = np.clip(points, 0.0, 1.0)
        values: Float64 = self._bottom + inside * self._length
        if self._any_log:
            values[..., self._log] = np.exp(values[..., self._log])
        if self._any_step:
            stepped = self._step > 0
            low, step = self._low[stepped], self._step[stepped]
            values[..., stepped] = low + np.floor((values[..., stepped] - low) / step + 0.5) * step
        values = np.where(inside == 0.0, self._low, np.where(inside == 1.0, self._high, values))
        return np.clip(values, self._low, self._high)  # logarithms are rounded

    def _placed(self, values: Float64) -> Float64:
        """Coordinates (..., m) of numbers (..., m)."""
        middle = self._scaled(values)
        if self._any_step:
            half = self._step / 2
            middle = self._scaled(values - half) / 2 + self._scaled(values + half) / 2
        return np.clip((middle - self._bottom) / self._length, 0.0, 1.0)


def _one_hot(chosen: Indices, n: int) -> Float64:
    points = np.full((len(chosen), n), _NOT_CHOSEN)
    points[np.arange(len(chosen)), chosen] = _CHOSEN
    return points
