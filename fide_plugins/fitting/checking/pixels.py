"""One image of a check: its views as arrays, what they hold, and how far two images differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.fitting.pictures import side_by_side
from fide_plugins.recording.figures import thumbnail
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_pixels
from fide_plugins.validation.pixels import Pixels

__all__ = ["Difference", "Image", "difference", "image_of", "mean_of", "small"]


@dataclass(frozen=True, eq=False)
class Image:
    """What was rendered.

    views: (H, W, C) each; of whole numbers divided by 255, of others as they are, 0 for NaN.
    kinds: type of the numbers of each view, as the renderer returned it.
    low, high: least and largest finite value; bytes are divided by 255.
    not_finite: number of values that are NaN or infinite.
    constant: whether each view has one color.
    """

    views: list[Float32]
    kinds: tuple[str, ...]
    low: float
    high: float
    not_finite: int
    constant: bool

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """(H, W, C) of each view."""
        return tuple(view.shape for view in self.views)


@dataclass(frozen=True)
class Difference:
    """Of two images, in units of their values.

    rms: root mean square.  most: largest absolute value.
    """

    rms: float
    most: float


def image_of(returned: Any) -> Image:
    """The image, or the list of views, that a renderer returned.

    Raises ImageError for what no image is.
    """
    if returned is None:
        raise ImageError("render returned None; let it return its image")
    several = isinstance(returned, list | tuple) and any(np.ndim(one) >= 2 for one in returned)
    given = list(returned) if several else [returned]
    arrays = [
        as_pixels(one, f"the image of view {i}" if several else "the image")
        for i, one in enumerate(given)
    ]
    views, bad = [], 0
    for array in arrays:
        view, wrong = _floats(array if array.ndim == 3 else array[..., None])
        views.append(view)
        bad += wrong
    return Image(
        views,
        tuple(str(array.dtype) for array in arrays),
        min(float(view.min()) for view in views),
        max(float(view.max()) for view in views),
        bad,
        all(bool((view == view[:1, :1]).all()) for view in views),
    )


def _floats(array: Pixels) -> tuple[Float32, int]:
    """Values (H, W, C), and how many of them were not finite."""
    values = np.asarray(array, np.float32)
    if array.dtype == np.uint8:
        values = values / np.float32(255)
    finite = np.isfinite(values)
    bad = int(values.size - np.count_nonzero(finite))
    if bad:
        least = values[finite].min() if finite.any() else np.float32(0)
        values = np.where(finite, values, least)
    return values, bad


def difference(a: Image, b: Image) -> Difference:
    """Of two images; infinite where they have different sizes."""
    if a.shapes != b.shapes:
        return Difference(np.inf, np.inf)
    square, count, most = 0.0, 0, 0.0
    for one, other in zip(a.views, b.views, strict=True):
        apart = one.astype(np.float64) - other
        square += float(np.square(apart).sum())
        count += apart.size
        most = max(most, float(np.abs(apart).max()))
    return Difference((square / count) ** 0.5, most)


def mean_of(images: list[Image]) -> Image:
    """The first of images of one size, with the mean of all as its views."""
    views = zip(*(image.views for image in images), strict=True)
    return replace(images[0], views=[np.mean(each, axis=0) for each in views])


def small(image: Image) -> Float32:
    """Picture (h, w, 3) of an image, views side by side, with the values that it has."""
    return thumbnail(side_by_side([_colors(view) for view in image.views]))


def _colors(view: Float32) -> Float32:
    """RGB (H, W, 3); transparency over white, as a fit does it."""
    if view.shape[2] == 4:
        return 1 - view[..., 3:] * (1 - view[..., :3])
    return np.repeat(view, 3, axis=2) if view.shape[2] == 1 else view
