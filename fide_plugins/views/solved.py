"""Whether an image equals the target but for what no eye sees.

The rule, of all pixels that count (those that a mask hides do not):

1. The mean squared error is at most that of rounding to 8 bits, (1/255)^2 / 12.
2. A pixel *differs* where a color is farther off than one step of 8 bits.  At most one pixel in
   1,000 differs, none by more than 16 steps, and no 3 x 3 pixels hold more than two that do.

So single antialiased pixels at an edge may be a little off.  A thing of several pixels may not:
where it covers three neighbors, the third rule of 2 sees it, however large the picture is.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from fide_plugins.types import Float32, Mask
from fide_plugins.views.views import Views

__all__ = ["is_solved"]

_STEP = 1 / 255
_ROUNDING = _STEP**2 / 12  # MSE between a picture and itself in 8 bits
_DIGITS = 1e-6  # by which two numbers in single precision may differ
_MOST = 16 * _STEP + _DIGITS
_SHARE = 1e-3  # of the pixels that count
_TOGETHER = 2  # of 3 x 3


def is_solved(views: Views, image: Float32) -> bool:
    """Whether a packed image (H, W, 3) equals the target, whatever the loss is."""
    if views.squared_error(image) > _ROUNDING:
        return False
    errors = views.largest_errors(image)
    if max(float(error.max()) for error in errors) > _MOST:
        return False
    differ = [error > _STEP + _DIGITS for error in errors]
    if sum(int(one.sum()) for one in differ) > _SHARE * views.counted:
        return False
    return not any(_together(one) > _TOGETHER for one in differ)


def _together(differ: Mask) -> int:
    """The most pixels (H, W) of any 3 x 3 that differ."""
    if not differ.any():
        return 0
    shares = uniform_filter(differ.astype(np.float64), 3, mode="constant")
    return round(9 * float(shares.max()))
