"""Whether an image equals the target but for what no eye sees.

A step is 1/255 of the target's range of values, in the color in which that is largest; half of the
target's own step of rounding is subtracted first.  The mean square is at most 1/12, that of
rounding to steps.  At most one pixel in 1,000, and ten, are off by more than one step in a color,
none by more than 16, and no 3 x 3 pixels hold more than two of them.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from fide_plugins.types import Float32
from fide_plugins.views.views import DIGITS, View, Views

_LEVELS = 255
_ROUNDING = 1 / 12  # mean square of rounding to whole steps
_MOST = 16  # steps
_SHARE, _SINGLE = 1e-3, 10  # of the pixels that count, and how many at most
_TOGETHER = 2  # of 3 x 3


def is_solved(views: Views, image: Float32) -> bool:
    """Whether a packed image (H, W, 3) equals the target, whatever the loss is."""
    parts = zip(views.views, views.split(image[None]), views.roundings, strict=True)
    return all(_equals(view, part[0], rounding) for view, part, rounding in parts)


def _equals(view: View, image: Float32, rounding: float) -> bool:
    """Whether an image (H, W, 3) equals a target with this largest error of rounding."""
    step = (view.contrast if view.contrast > DIGITS else 1.0) / _LEVELS
    errors = np.abs(image - view.target)
    if rounding:
        errors = np.maximum(errors - np.float32(rounding + DIGITS), 0, dtype=np.float32)
    squares = np.square(errors).mean(axis=-1, dtype=np.float64)
    if np.average(squares, weights=view.weights) > _ROUNDING * step**2:
        return False
    largest = errors.max(axis=-1)
    if view.hidden is not None:
        largest[view.hidden] = 0
    differ = largest > step + DIGITS
    number = int(differ.sum())
    if float(largest.max()) > _MOST * step + DIGITS or number > min(_SHARE * view.counted, _SINGLE):
        return False
    together = 9 * uniform_filter(differ.astype(np.float64), 3, mode="constant").max()
    return round(float(together)) <= _TOGETHER
