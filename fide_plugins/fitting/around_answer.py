"""Renders around the answer of a fit, from which its standard deviations are computed.

Two renders a number, at either side of the answer, and one of the answer itself, which tells
whether the renderer has noise: then nothing is said, as where a render fails.  A parameter whose
image changes by curvature rather than by slope gets two more, nearer.  Where it does so there, too,
it changes in jumps, as hard edges do, and no less than that step is claimed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.pictures import canonical
from fide_plugins.fitting.rendering import Rendered
from fide_plugins.fitting.workers.base import Workers
from fide_plugins.fitting.workers.gather import gathered
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32, Float64, Indices, Mask
from fide_plugins.uncertainty.at_answer import deviations_at

__all__ = ["numbers", "std_around"]

_STEP, _NEARER = 0.005, 0.2  # of the cube; times as far
_CURVED = 0.25  # energy of the second difference beside that of the first
_STRAIGHTER = 0.5  # of the curvature, below which the nearer step is taken
_TINY = 1e-300
_SAME = 2e-6  # by which a GPU renders the same image anew


def numbers(optimizer: FIDE) -> Indices:
    """Axes (p,) of numbers: all but integers and choices."""
    layout = optimizer.state.search.setting.layout
    free = np.ones(optimizer.dim, bool) if layout is None else ~layout.discrete
    return np.flatnonzero(free)


def std_around(
    optimizer: FIDE, workers: Workers, timeout: float | None
) -> tuple[Float64 | None, int]:
    """Standard deviations (dim,) of the best candidate, None if unknown; number of renders."""
    best, axes = optimizer.state.best, numbers(optimizer)
    assert best is not None and best.solution.image is not None
    around = _Around(optimizer, workers, timeout, best.solution.x, best.solution.image)
    if not around.is_the_same_again():
        return None, around.renders
    sides = around.either_side(axes, _STEP)
    if sides is None:
        return None, around.renders
    curved = around.curvature(sides) > _CURVED
    nearer = around.either_side(axes[curved], _NEARER * _STEP)
    if nearer is None:
        return None, around.renders
    straighter = around.curvature(nearer) < _STRAIGHTER * around.curvature(sides.of(curved))
    sides.put(np.flatnonzero(curved)[straighter], nearer.of(straighter))
    jumps = np.flatnonzero(curved)[~straighter]
    std = np.full(optimizer.dim, np.nan)
    std[axes] = around.deviations(sides)
    std[axes[jumps]] = np.maximum(std[axes[jumps]], _NEARER * _STEP)
    return std, around.renders


class _Sides(NamedTuple):
    """Images at either side of the answer, in p directions.

    low, high: (p, H, W, 3), packed.  spans: (p,), how far they are apart.
    """

    low: Float32
    high: Float32
    spans: Float64

    def of(self, which: Mask) -> _Sides:
        """Those of some directions (p,)."""
        return _Sides(self.low[which], self.high[which], self.spans[which])

    def put(self, at: Indices, others: _Sides) -> None:
        """Put others in place of those of some directions (m,)."""
        self.low[at], self.high[at], self.spans[at] = others


class _Around:
    """Renders around the answer x (d,), whose packed image (H, W, 3) is known."""

    def __init__(
        self,
        optimizer: FIDE,
        workers: Workers,
        timeout: float | None,
        x: Float64,
        image: Float32,
    ) -> None:
        self._optimizer, self._workers, self._timeout = optimizer, workers, timeout
        self._x, self._image = x, image
        self.renders = 0

    def is_the_same_again(self) -> bool:
        """Whether the answer has the same image when it is rendered again."""
        again = self._render(self._x[None])
        return again is not None and bool(np.abs(again[0] - self._image).max() <= _SAME)

    def either_side(self, axes: Indices, step: float) -> _Sides | None:
        """Images of steps on these axes (p,); None if a render fails.

        At a wall, and where a step is not valid, it is one-sided; on a periodic axis there is no
        wall.  None, too, where neither side is valid.
        """
        optimizer, periodic = self._optimizer, np.zeros(len(self._x), bool)
        layout = optimizer.state.search.setting.layout
        if layout is not None:
            periodic = layout.periodic
        X = np.repeat(self._x[None], 2 * len(axes), axis=0)
        spans = np.zeros(len(axes))
        for row, point in enumerate(X):
            i, sign = row // 2, 1 if row % 2 else -1
            end = self._x[axes[i]] + sign * step
            end = end if periodic[axes[i]] else min(max(end, 0.0), 1.0)
            point[axes[i]] = end % 1.0 if periodic[axes[i]] else end
            if optimizer.validity is None or optimizer.validity.allows(point):
                spans[i] += abs(end - self._x[axes[i]])
            else:
                point[axes[i]] = self._x[axes[i]]
        images = None if (spans == 0).any() else self._render(X)
        return None if images is None else _Sides(images[0::2].copy(), images[1::2].copy(), spans)

    def curvature(self, sides: _Sides) -> Float64:
        """(p,), energy of the second difference beside that of the first."""
        second = sides.low + sides.high - 2 * self._image
        parts = (np.square(one, dtype=np.float64).sum((1, 2, 3)) for one in
                 (second, sides.high - sides.low))  # fmt: skip
        bent, straight = parts
        return np.asarray(bent / np.maximum(straight, _TINY), np.float64)

    @one_thread
    def deviations(self, sides: _Sides) -> Float64:
        """(p,), standard deviations."""
        views, image = self._optimizer.views, self._image
        apart = [
            views.differences(high, low)
            for low, high in zip(sides.low, sides.high, strict=True)
        ]  # fmt: skip
        spans = sides.spans[:, None, None, None]
        slopes = [np.array(one) / spans for one in zip(*apart, strict=True)]
        residuals = views.differences(views.target, image)
        weights = views.differences(np.ones_like(image), np.zeros_like(image))
        images = [one[0].astype(np.float64) for one in views.split(image[None])]
        return deviations_at(slopes, residuals, images, weights)

    def _render(self, X: Float64) -> Float32 | None:
        """Packed images (n, H, W, 3) of points X (n, d); None if one fails."""
        images = []
        for outcome in gathered(self._workers, X, self._timeout):
            self.renders += 1
            if not isinstance(outcome, Rendered):
                return None
            try:
                images.append(canonical(self._optimizer, outcome.image))
            except ImageError:
                return None
        shape = (len(X), *self._image.shape)
        return np.array(images, np.float32).reshape(shape)
