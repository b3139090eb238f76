"""What images say of a run: all are equal; one equals the target, or differs by noise alone.

To the eye an image equals the target where this holds, in steps of 1/255 of the target's range of
values, in the color in which that is largest, less half of the target's own step of rounding.  The
mean square is at most 1/12, that of rounding to steps.  At most one pixel in 1,000, and ten, are
off by more than one step in a color, none by more than 16, and no 3 x 3 pixels hold more than two.

Noise of path tracers and cameras is independent from pixel to pixel.  Half of the mean squared
difference of two renders of one candidate is the variance of a pixel.  Where an image is right, its
difference from the target is noise of up to twice that: neighbors are not correlated, and no mean
of 3 x 3 to 8 x 8 pixels stands out.  Where the target has more noise than the renders, it must be
as strong all over the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import chdtrc, ndtri, stdtrit

from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.schema import Schema, array, check, maybe, real
from fide_plugins.types import Float32, Float64
from fide_plugins.views.views import DIGITS, View, Views

# -- all images are equal --------------------------------------------------------------------------

_ENOUGH = 32  # candidates, which lie around the start, so that a parameter may show only elsewhere
_SAME = 2e-6  # a GPU renders the same image with other last bits: by 1e-7 to 1e-6
_RELATIVE, _ABSOLUTE = 1e-4, 1e-9  # by which losses of such images differ at most


@dataclass(eq=False)
class SameImages:
    """Whether all images that were told so far are equal, but for rounding on a GPU.

    A run that was loaded does not know.  Where losses differ, they were told beside the images and
    judge something else: nothing is said.

    generation: candidates of a generation, of which each counts before anything is said.
    """

    generation: int
    _first: tuple[Float64, Float32, float] | None = None  # point, image and loss
    _count: int | None = 0  # None: two images differ, or it is not known
    _moved: bool = False  # whether there are two different points

    @property
    def number(self) -> int:
        """How many candidates have the same image; 0: too few to say so."""
        count = self._count if self._moved else 0
        return count if count and count >= max(self.generation, _ENOUGH) else 0

    def forget(self) -> None:
        """Say nothing from now on."""
        self._count = self._first = None

    def note(self, points: Float64, images: Float32 | None, losses: Float64) -> None:
        """Note images (n, H, W, 3) and losses (n,) of points (n, d); warns once if all are equal.

        images: None: nothing is known of these candidates.
        """
        if self._count is None or not len(points):
            return
        if images is None:
            self.forget()
            return
        if self._first is None:
            self._first = points[0].copy(), images[0].copy(), float(losses[0])
        point, image, loss = self._first
        with np.errstate(over="ignore"):  # of the largest numbers
            close = np.isclose(losses, loss, rtol=_RELATIVE, atol=_ABSOLUTE).all()
        if not (close and (abs(images - image) <= _SAME).all()):
            self.forget()
            return
        known, self._count = self.number, self._count + len(points)
        self._moved = self._moved or bool((points != point).any())
        if self.number and not known:
            warn_user(
                f"all images of the first {self.number} candidates are equal: no parameter has "
                "changed the image so far; does render use its parameters, and do their ranges "
                "change what is seen? (These candidates lie around the start of the search: "
                "elsewhere in the box images may differ.)"
            )


# -- equal to the target, to the eye ---------------------------------------------------------------

_STEPS = 255
_ROUNDED = 1 / 12  # mean square of rounding to whole steps
_FARTHEST = 16  # steps
_SHARE, _SINGLE = 1e-3, 10  # of the pixels that count, and how many at most
_TOGETHER = 2  # of 3 x 3


def is_solved(views: Views, image: Float32) -> bool:
    """Whether a packed image (H, W, 3) equals the target, whatever the loss is."""
    parts = zip(views.views, views.split(image[None]), views.roundings, strict=True)
    return all(_equals(view, part[0], rounding) for view, part, rounding in parts)


def _equals(view: View, image: Float32, rounding: float) -> bool:
    """Whether an image (H, W, 3) equals a target with this largest error of rounding."""
    step = (view.contrast if view.contrast > DIGITS else 1.0) / _STEPS
    errors = np.abs(image - view.target)
    if rounding:
        errors = np.maximum(errors - np.float32(rounding + DIGITS), 0, dtype=np.float32)
    squares = np.square(errors).mean(axis=-1, dtype=np.float64)
    if np.average(squares, weights=view.weights) > _ROUNDED * step**2:
        return False
    largest = errors.max(axis=-1)
    if view.hidden is not None:
        largest[view.hidden] = 0
    differ = largest > step + DIGITS
    number = int(differ.sum())
    if float(largest.max()) > _FARTHEST * step + DIGITS or number > min(
        _SHARE * view.counted, _SINGLE
    ):
        return False
    together = 9 * uniform_filter(differ.astype(np.float64), 3, mode="constant").max()
    return round(float(together)) <= _TOGETHER


# -- different by noise alone ----------------------------------------------------------------------

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
        self.repeat: Float32 | None = None
        """A first render of the candidate that is rendered twice, while that is tested."""
        self._last: tuple[tuple[object, ...], float | None] = ((), None)  # what `left` said
        self.variance: float | None = None
        """Mean over pixels of the variance of their values; None where it was not measured."""

    def note(self, image: Float32) -> None:
        """Note a render (H, W, 3) of the candidate that is rendered twice; it is kept, no copy."""
        if self.repeat is None:
            self.repeat = image
            return
        self.variance = _mean_square(self._views.differences(image, self.repeat)) / 2
        self.repeat = None

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
        return {"variance": self.variance, "repeat": self.repeat}

    def load_state_dict(self, state: Mapping[str, Any], sides: Mapping[str, int]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        check(state, _SCHEMA, dict(sides), "pixel_noise")
        self.variance, self.repeat = state["variance"], state["repeat"]


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
