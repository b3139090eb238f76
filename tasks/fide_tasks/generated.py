"""Tasks whose targets are drawn until every parameter shows.

A scene is drawn in sides: lengths relative to the shorter side of the image, x to the right and y
down from its center. So the same parameters show the same picture at every resolution.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image, Task, Vector

_JUDGING_SIDE = 64  # generated targets are judged on images of about this many pixels a side
_STEP = 0.02  # of the range of a parameter
_DRAWS = 200  # of a target at most; then the best of them


class GeneratedTask(Task):
    """A task without noise that draws its own targets.

    A target is accepted if each parameter shows: a step of 0.02 of its range, up or down, changes
    the image by `least_change` on average, measured at about 64 x 64 pixels (mean absolute
    difference over all pixels and channels). Otherwise the groups of the parameters that do not
    show are drawn again; all parameters, where a parameter belongs to no group. Of 200 draws that
    all fail, the task takes the one whose least visible parameter shows most.

    `_render` must take the size of the image from `out`, not from the task.
    """

    least_change: ClassVar[float] = 2e-4

    @abstractmethod
    def _draw(self, rng: np.random.Generator) -> Vector:
        """Draw the parameters of a target, (dim,) in [0, 1]."""

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, self.dim))
        x = best = self._draw(rng)
        most = -1.0
        for _ in range(_DRAWS):
            shown = self._changes(x)
            if shown.min() > most:
                best, most = x, float(shown.min())
            hidden = shown < self._required_change()
            if not hidden.any():
                break
            x = self._drawn_again(x, hidden, rng)
        return best

    def _required_change(self) -> float:
        """Mean change of the image by a step of a parameter from which on it counts as visible."""
        return self.least_change

    def _changes(self, x: Vector) -> Vector:
        """Mean absolute change of the image by a step up or down of each parameter, (dim,)."""
        step = np.where(x < 0.5, _STEP, -_STEP)
        candidates = np.vstack([x, x + np.diag(step)])
        images: Image = np.empty((len(candidates), *self._judging_size(), 3), np.float32)
        self._render(self._physical(candidates), images, np.zeros(len(candidates), np.uint32))
        change: Vector = np.abs(images[1:] - images[0]).mean(axis=(1, 2, 3), dtype=np.float64)
        return change

    def _judging_size(self) -> tuple[int, int]:
        height, width = self.size
        scale = _JUDGING_SIDE / math.sqrt(height * width)
        return max(1, round(height * scale)), max(1, round(width * scale))

    def _drawn_again(
        self, x: Vector, hidden: NDArray[np.bool_], rng: np.random.Generator
    ) -> Vector:
        fresh = self._draw(rng)
        again = [group for group in self.groups or [] if hidden[group].any()]
        if hidden.sum() > sum(hidden[group].sum() for group in again):
            return fresh
        x = x.copy()
        for group in again:
            x[group] = fresh[group]
        return x


@cache
def axes(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where the pixel centers are, in sides: x (1, W) and y (H, 1). Do not change them."""
    side = min(height, width)
    x, y = ((np.arange(n) + 0.5 - n / 2) / side for n in (width, height))
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


def half_extent(size: tuple[int, int]) -> tuple[float, float]:
    """Return how far the image reaches from its center, in sides: across and down."""
    height, width = size
    return width / (2 * min(size)), height / (2 * min(size))


# -- limbs: thick rods with round ends, drawn with smooth edges into a float image -----------------
#
# A limb from a to b has the radius ra at a and rb at b. With a + t (b - a), t in [0, 1], the
# nearest point of its segment and d the distance from that, a pixel is covered by
# clip(r(t) - d + 1/2, 0, 1), where r(t) = ra + t (rb - ra); all in pixels. So the image varies
# continuously with every number, and a limb thinner than a pixel fades.


_ROUNDNESS = 0.4  # how much darker a limb is at its edge than along its middle

_HALF = np.float32(0.5)

Plane = NDArray[np.float32]
Point = Sequence[float]  # (x, y)
Window = tuple[slice, slice]


def paint_limb(frame: Image, a: Point, b: Point, ra: float, rb: float, color: Plane) -> None:
    """Paint a limb over the frame, (H, W, 3); a, b: (x, y) in pixels; ra, rb: radii in pixels."""
    window = _window(frame.shape[:2], a, b, max(ra, rb) + 0.5)
    if window is None:
        return
    d, r = _distance(window, a, b, ra, rb)
    covered = _clipped(r - d + _HALF)[:, :, None]
    rim = d / np.maximum(r, _HALF)
    np.minimum(rim, 1, out=rim)
    rim *= rim
    rim *= np.float32(-_ROUNDNESS)
    rim += 1
    part = frame[window]
    part += covered * (rim[:, :, None] * color - part)


def cast_shadow(shadow: Plane, a: Point, b: Point, ra: float, rb: float, soft: float) -> None:
    """Enter a limb's shadow into the plane, (H, W); its edge is `soft` >= 1 pixels wide."""
    window = _window(shadow.shape, a, b, max(ra, rb) + soft / 2)
    if window is not None:
        d, r = _distance(window, a, b, ra, rb)
        covered = _clipped((r - d) * np.float32(1 / soft) + _HALF)
        np.maximum(shadow[window], covered, out=shadow[window])


def _window(shape: tuple[int, ...], a: Point, b: Point, reach: float) -> Window | None:
    """Return the part of the image that a limb touches; None if it is outside."""
    spans = []
    for axis, n in ((1, shape[0]), (0, shape[1])):
        low, high = min(a[axis], b[axis]) - reach, max(a[axis], b[axis]) + reach
        first, end = max(0, math.floor(low)), min(n, math.ceil(high))
        if first >= end:
            return None
        spans.append(slice(first, end))
    return spans[0], spans[1]


def _distance(window: Window, a: Point, b: Point, ra: float, rb: float) -> tuple[Plane, Plane]:
    """Return each pixel's distance d from the segment, and the radius r(t) there."""
    rows, columns = window
    x = (np.arange(columns.start, columns.stop) + (0.5 - a[0])).astype(np.float32)[None]
    y = (np.arange(rows.start, rows.stop) + (0.5 - a[1])).astype(np.float32)[:, None]
    ux, uy = b[0] - a[0], b[1] - a[1]
    scale = 1 / max(ux * ux + uy * uy, 1e-12)
    t = _clipped(x * np.float32(ux * scale) + y * np.float32(uy * scale))
    dx, dy = x - t * np.float32(ux), y - t * np.float32(uy)
    dx *= dx
    dy *= dy
    dx += dy
    t *= np.float32(rb - ra)
    t += np.float32(ra)
    return np.sqrt(dx, out=dx), t


def _clipped(plane: Plane) -> Plane:
    """Limit to [0, 1], in place; `np.clip` takes longer on small arrays."""
    np.maximum(plane, 0, out=plane)
    return np.minimum(plane, 1, out=plane)
