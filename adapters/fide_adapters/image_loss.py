"""What an objective may return in place of a bare loss: the loss together with its image."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np

from fide_plugins.errors import ImageError, LossError
from fide_plugins.types import Float32
from fide_plugins.validation.images import is_path, is_pil, is_torch_tensor
from fide_plugins.validation.values import Clipping
from fide_plugins.views import Views


class ImageLoss(float):
    """A loss that carries the image that it was computed from.

        return ImageLoss(loss, image)

    It is a float, so every framework and every other optimizer can use it.  The image stays
    attached, also through pickle; arithmetic and `float()` give plain floats without it.

    loss: one real number, the lower the better; NaN and infinity are allowed.
    image: anything that `FIDE.tell` takes for one candidate, also the path of a file on a disk that
        workers share; for a list of targets a list of them.  It is neither copied nor checked
        before the optimizer gets it.

    Raises LossError, a ValueError, if the loss is not a real number.
    """

    image: object

    def __new__(cls, loss: float, image: object = None) -> Self:
        """Make the float."""
        if not hasattr(loss, "__float__") or np.shape(loss) != ():
            raise LossError(f"the loss of an ImageLoss must be one real number, not {loss!r}")
        self = super().__new__(cls, loss)
        self.image = image
        return self


class ImageReader:
    """Reads the images that objectives give, one at a time, for the views of one target."""

    def __init__(self, views: Views) -> None:
        self._views = views
        self._clipping = Clipping()

    def __call__(self, image: object) -> Float32:
        """Canonical batch (1, H, W, 3) of an image, or of a list of them; not always a copy.

        Warns once of values outside [0, 1].  Raises ImageError, or ValueRangeError for images on
        another scale.
        """
        views = self._views
        if not views.listed:
            is_array = isinstance(image, np.ndarray) and image.shape == views.target.shape
            batch: object = image[None] if is_array else [image]  # type: ignore[index]  # no copy
        elif not isinstance(image, list | tuple) or len(image) != len(views.views):
            raise ImageError(
                f"with {len(views.views)} targets a render is a list of {len(views.views)} images, "
                f"one for each view, {views.sizes}; got a {type(image).__name__} of another length"
            )
        else:
            batch = [[one] for one in image]
        return views.as_batch(batch, 1, self._clipping)


class Result(NamedTuple):
    """The parts of what an objective returned.

    loss: not checked; None: the optimizer's own loss of the image.
    image: None if there is none.
    """

    loss: Any
    image: Any = None


def read_result(result: object) -> Result:
    """Parts of an `ImageLoss`, an image, a pair (loss, image), or (loss, None).

    Anything else is regarded as a loss.
    """
    if isinstance(result, ImageLoss):
        return Result(float(result), result.image)
    if is_image(result):
        return Result(None, result)
    if isinstance(result, tuple) and len(result) == 2:
        loss, image = result
        if image is None or is_image(image):
            return read_result(loss) if image is None else Result(loss, image)
    return Result(result)


def is_image(value: Any) -> bool:
    """Whether a value is an image, and not a number or a list of numbers.

    Images are paths, PIL images, arrays, torch tensors and nested lists of two or more axes, and
    lists of these, which are views.  Their contents are not checked.
    """
    if isinstance(value, list | tuple):
        if len(value) > 0 and all(is_image(one) for one in value):
            return True
        try:
            return all(isinstance(one, list | tuple) for one in value) and np.ndim(value) >= 2
        except ValueError:  # lists of different lengths
            return False
    if is_path(value) or is_pil(value):
        return True
    return (isinstance(value, np.ndarray) or is_torch_tensor(value)) and value.ndim >= 2


def views_of(
    target: object, mask: object, weights: object, value_range: object = None
) -> Views | None:
    """Views where a target is optional; ImageError for a mask without a target."""
    if target is None:
        if not (mask is None and weights is None and value_range is None):
            raise ImageError("mask, weights and value_range belong to a target: set target=, too")
        return None
    return Views.read(target, mask, weights, value_range)
