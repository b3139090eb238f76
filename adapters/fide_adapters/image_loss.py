"""What an objective may return in place of a bare loss: the loss together with its image."""

from __future__ import annotations

import os
from typing import Any, NamedTuple, Self

import numpy as np

from fide_plugins.errors import ImageError, ImageNotFoundError, LossError
from fide_plugins.types import Float32
from fide_plugins.validation import images
from fide_plugins.validation.image_files import read_pixels
from fide_plugins.validation.pixels import Clipping, is_path, is_pil, is_torch_tensor
from fide_plugins.views import Views

__all__ = ["ImageLoss", "ImageReader", "ImageRef", "Result", "is_image", "read_result"]


class ImageLoss(float):
    """A loss that carries the image that it was computed from.

        return ImageLoss(loss, image)

    It is a float, so every framework and every other optimizer can use it.  The image stays
    attached, also through pickle; arithmetic and `float()` give plain floats without it.

    loss: one real number, the lower the better; NaN and infinity are allowed.
    image: anything that `FIDE.tell` takes for one candidate, or an `ImageRef`; for a list of
        targets a list of them.  It is neither copied nor checked before the optimizer gets it.

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


class ImageRef:
    """An image by the name of its file, for workers that share a disk with the optimizer.

    path: an image file, or a `.npy` file of one array (H, W) or (H, W, C), uint8 in [0, 255] or
        float in [0, 1], which is read without loss.  It is made absolute at once, because the
        optimizer may run in another working folder.

    The optimizer reads the file when it gets the result, and does not need it afterwards.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.path.abspath(os.fspath(path))

    def __repr__(self) -> str:
        return f"ImageRef({self.path!r})"

    def load(self, raw: bool = False) -> Any:
        """Array (H, W) or (H, W, C); raw: with the numbers of the file, for a range of values.

        Raises `ImageNotFoundError`, or `ImageError` for a file that is not an image.
        """
        if not self.path.endswith(".npy"):
            return read_pixels(self.path, None, raw=True) if raw else images.load(self.path)
        try:
            return np.load(self.path, allow_pickle=False)
        except FileNotFoundError as error:
            raise ImageNotFoundError(f"no image file at {self.path!r}") from error
        except (OSError, ValueError, EOFError) as error:
            raise ImageError(f"cannot read {self.path!r} as an array: {error}") from error


class ImageReader:
    """Reads the images that objectives give, one at a time, for one target.

    views: of the target.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._clipping = Clipping()

    def __call__(self, image: object) -> Float32:
        """Canonical batch (1, H, W, 3) of an image or an `ImageRef`, or a list of them, packed.

        Not always a copy.  Warns once of values outside [0, 1].  Raises `ImageError`, or as
        `ImageRef.load`; a ValueRangeError for images on another scale.
        """
        raw = self._views.values is not None
        return self._views.batch_of_one(_loaded(image, raw), self._clipping)


def _loaded(image: object, raw: bool) -> object:
    """An image, or the list, with its references loaded."""
    if isinstance(image, list | tuple):
        return [_loaded(one, raw) for one in image]
    return image.load(raw) if isinstance(image, ImageRef) else image


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

    Images are `ImageRef`, paths, PIL images, arrays, torch tensors and nested lists of two or more
    axes, and lists of these, which are views.  Their contents are not checked.
    """
    if isinstance(value, list | tuple):
        return len(value) > 0 and (all(is_image(one) for one in value) or _is_table(value))
    if isinstance(value, ImageRef) or is_path(value) or is_pil(value):
        return True
    return (isinstance(value, np.ndarray) or is_torch_tensor(value)) and value.ndim >= 2


def _is_table(value: list[Any] | tuple[Any, ...]) -> bool:
    """Whether it is lists of equal length, which are an array of two or more axes."""
    if not all(isinstance(one, list | tuple) for one in value):
        return False
    try:
        return np.ndim(value) >= 2
    except ValueError:  # of different lengths
        return False
