"""Limbs: thick rods with round ends, drawn with smooth edges into a float image.

A limb from a to b has the radius ra at a and rb at b. With a + t (b - a), t in [0, 1], the nearest
point of its segment and d the distance from that, a pixel is covered by clip(r(t) - d + 1/2, 0, 1),
where r(t) = ra + t (rb - ra); all in pixels. So the image varies continuously with every
number, and a limb thinner than a pixel fades.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image

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
