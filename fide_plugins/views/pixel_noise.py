"""Noise that is independent from pixel to pixel, as that of path tracers and cameras is.

Half of the mean squared difference of two renders of one candidate is the variance of a pixel.
Where an image is right, its difference from the target is noise of up to twice that: neighbors are
not correlated, and no mean of 3 x 3 to 8 x 8 pixels stands out.  Where the target has more noise
than the renders, it must be as strong all over the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import chdtrc, ndtri, stdtrit

from fide_plugins.runtime.schema import Schema, array, check, maybe, real
from fide_plugins.types import Float32, Float64
from fide_plugins.views.views import Views

_LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))  # rows, columns to a neighbor
_CORRELATED = 0.1  # correlation of neighbors from which on a difference is no noise alone
_WINDOW = 8  # pixels of a side, whose differences of neighbors say how strong noise is there
_FREE = 37  # degrees of freedom of that
_SIDES = (3, 5, 8)  # pixels of a side, of which the mean must not stand out: strong pixels may
_EVEN_SIDES = (1, 2, *_SIDES)  # where noise is as strong everywhere
_SPOT = 5e-3  # probability of one such mean in a picture
_QUIET = 0.1  # of the standard deviation of all pixels, the least one that a window is given
_LEAST = 400  # pixels, of which a correlation has a standard error of 0.05
_MOST = 2.5  # times the variance of a pixel: twice, if the target has noise, and a reserve
_CHANCE = 4.0  # standard errors of the correlation of neighbors that is allowed
_FAINT, _DENSE = 0.01, 0.7  # of the mean square; so many pixels must exceed it, by chance 0.92
_SIDE = 9  # pixels of a square with more noise than chance explains
_RARE = 1e-3  # probability of one such square in a picture
_TINY = 1e-300
_SCHEMA: dict[str, Schema] = {
    "variance": maybe(real(0.0)),
    "repeat": maybe(array("H", "W", 3, low=0.0, high=1.0)),
}


class PixelNoise:
    """The variance of pixels, measured, and whether it is all that is left.

    views: their weights say which pixels count.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._repeat: Float32 | None = None  # a first render of the candidate
        self._last: tuple[tuple[object, ...], float | None] = ((), None)  # what `left` said
        self.variance: float | None = None
        """Mean over pixels of the variance of their values; None where it was not measured."""

    def note(self, image: Float32) -> None:
        """Note a render (H, W, 3) of the candidate that is rendered twice; it is kept, no copy."""
        if self._repeat is None:
            self._repeat = image
            return
        self.variance = _mean_square(self._views.differences(image, self._repeat)) / 2
        self._repeat = None

    def forget_repeat(self) -> None:
        """The test is over, also if only one render came back."""
        self._repeat = None

    def left(self, image: Float32, target: Float32) -> float | None:
        """Standard deviation of a pixel, if noise is all in which an image differs from a target.

        image, target: (H, W, 3).  None: there is something else, or nobody knows: no candidate was
        rendered twice yet.
        """
        if self.variance is None:
            return None
        asked = (image, target, self.variance)
        if list(map(id, self._last[0])) != list(map(id, asked)):  # `_last` keeps them alive
            self._last = asked, self._left(*asked)
        return self._last[1]

    def _left(self, image: Float32, target: Float32, variance: float) -> float | None:
        apart = self._views.differences(image, target)
        square = _mean_square(apart)
        if 0 < square <= _MOST * variance:
            return float(np.sqrt(variance)) if all(map(is_noise, apart)) else None
        pairs = zip(apart, self._views.views, strict=True)
        even = square and all(is_even_noise(one, view.counted) for one, view in pairs)
        return float(np.sqrt(square)) if even else None

    def state_dict(self) -> dict[str, Any]:
        """Everything; the image is the one in use, not a copy."""
        return {"variance": self.variance, "repeat": self._repeat}

    def load_state_dict(self, state: Mapping[str, Any], sides: Mapping[str, int]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        check(state, _SCHEMA, dict(sides), "pixel_noise")
        self.variance, self._repeat = state["variance"], state["repeat"]


def _mean_square(differences: list[Float64]) -> float:
    return float(np.mean([np.square(each).mean() for each in differences]))


def is_noise(difference: Float64) -> bool:
    """Whether a difference of two images (H, W, 3) is independent from pixel to pixel.

    None at all is.  Where fewer than 400 pixels differ nothing can be said: False.
    """
    if not _is_uncorrelated(difference, _CORRELATED):
        return False
    if min(difference.shape[:2]) < _WINDOW:
        return True
    seen = _without_copies(difference)
    steps = np.square(np.diff(seen, axis=1, append=seen[:, -2:-1])) / 2
    variances = uniform_filter(steps, (_WINDOW, _WINDOW, 1))  # it may vary over the picture
    least = max(_QUIET**2 * float(np.square(seen).mean()), _TINY)
    limit = stdtrit(_FREE, 1 - _SPOT / (2 * seen.size * len(_SIDES)))
    return not _stands_out(seen, _SIDES, np.maximum(variances, least), limit)


def is_even_noise(difference: Float64, counted: int) -> bool:
    """As `is_noise`, with as much of it all over the picture.

    counted: number of pixels that count; the others do not differ.
    """
    squares = np.square(difference).mean(axis=-1)
    mean = float(squares.sum()) / counted
    if np.count_nonzero(squares > _FAINT * mean) < _DENSE * counted:
        return False
    if not _is_uncorrelated(difference, min(_CORRELATED, _CHANCE / counted**0.5)):
        return False
    side = min(_SIDE, *squares.shape)
    inside = tuple(slice(side // 2, length - (side - 1) // 2) for length in squares.shape)
    largest = float(uniform_filter(squares, side)[inside].max())
    # independent from pixel to pixel, and perhaps the same in all colors: chi-squared
    if chdtrc(side**2, side**2 * largest / mean) < _RARE / counted:
        return False
    seen = _without_copies(difference)
    variances = np.maximum(np.square(seen).sum(axis=(0, 1)) / counted, _TINY)
    number = counted * seen.shape[-1] * len(_EVEN_SIDES)
    return not _stands_out(seen, _EVEN_SIDES, variances, -ndtri(_SPOT / (2 * number)))


def _is_uncorrelated(difference: Float64, limit: float) -> bool:
    """Whether at least 400 pixels differ, or none, and neighbors are correlated by that at most."""
    if 0 < np.count_nonzero(difference.any(axis=-1)) < _LEAST:
        return False
    height, width, _ = difference.shape
    total = float(np.square(difference).sum())
    for down, right in _LAGS:
        one = difference[: height - down, max(0, -right) : width - max(0, right)]
        other = difference[down:, max(0, right) : width + min(0, right)]
        if abs(float((one * other).sum())) > limit * total:
            return False
    return True


def _without_copies(difference: Float64) -> Float64:
    """One channel (H, W, 1) of gray, else all three."""
    gray = bool((difference == difference[..., :1]).all())
    return difference[..., :1] if gray else difference


def _stands_out(
    difference: Float64, sides: Sequence[int], variances: Float64, limit: float
) -> bool:
    """Whether the mean of any square of pixels is farther from 0 than chance explains."""
    for side in sides:
        means = uniform_filter(difference, (side, side, 1), mode="constant")
        if (np.square(means) * side**2 > limit**2 * variances).any():
            return True
    return False
