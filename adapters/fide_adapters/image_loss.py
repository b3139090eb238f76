"""What an objective may return in place of a bare loss: the loss together with its image.

    return ImageLoss(loss, image)                         # any image that `FIDE.tell` takes, a path
    return ImageLoss(loss, image=ImageRef("/shared/17.png"))  # a file that the optimizer can read
    return ImageLoss(loss, features=tokens)               # (T, C), encoded by the worker
    return ImageLoss(loss, [front, side])                 # for a list of targets

An `ImageLoss` is a float, so every framework and every other optimizer can use it.  The image
stays attached to this float, also through pickle to and from worker processes.  Arithmetic and
`float()` give plain floats without the image.
"""

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

__all__ = [
    "ImageLoss",
    "ImageReader",
    "ImageRef",
    "Result",
    "is_image",
    "read_result",
    "resolve_image",
]


class ImageLoss(float):
    """A loss that carries the image, or the features of the image, that it was computed from.

    Parameters
    ----------
    loss
        one real number, the lower the better; NaN and infinity are allowed.
    image
        anything that `fide_plugins.validation.images.as_target` takes, or an `ImageRef`; for a
        list of targets a list of them.  It is neither copied nor checked before the optimizer gets
        it.
    features
        in place of an image: its tokens (T, C), computed with the optimizer's own encoder.  Prefer
        a NumPy array, which can be sent between processes cheaply.
    version
        attribute `version` of the encoder that made the features.  It must equal that of the
        optimizer's encoder; None: it is not compared.

    Raises
    ------
    LossError
        the loss is not a real number, or both image and features are given (also a ValueError).
    """

    image: object
    features: object
    version: str | None = None

    def __new__(
        cls,
        loss: float,
        image: object = None,
        *,
        features: object = None,
        version: str | None = None,
    ) -> Self:
        """Make the float."""
        if not hasattr(loss, "__float__") or np.shape(loss) != ():
            raise LossError(f"the loss of an ImageLoss must be one real number, not {loss!r}")
        if image is not None and features is not None:
            raise LossError("an ImageLoss has an image or its features, not both")
        self = super().__new__(cls, loss)
        self.image, self.features, self.version = image, features, version
        return self


class ImageRef:
    """An image by the name of its file, for workers that share a disk with the optimizer.

    path: an image file, or a `.npy` file of one array (H, W) or (H, W, C), uint8 in [0, 255] or
        float in [0, 1], which is read without loss.  It is made absolute at once, because the
        optimizer may run in another working folder.

    The optimizer reads the file when it gets the result, and does not need it afterwards.
    """

    __slots__ = ("path",)

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.path.abspath(os.fspath(path))

    def __repr__(self) -> str:
        return f"ImageRef({self.path!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ImageRef) and self.path == other.path

    def __hash__(self) -> int:
        return hash(self.path)

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


def resolve_image(image: object, raw: bool = False) -> object:
    """Load `image`, or what is in a list, if it is a reference.  Raises as `ImageRef.load`."""
    if isinstance(image, list | tuple):
        return [resolve_image(one, raw) for one in image]
    return image.load(raw) if isinstance(image, ImageRef) else image


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
        return self._views.batch_of_one(resolve_image(image, raw), self._clipping)


class Result(NamedTuple):
    """The parts of what an objective returned.

    loss: not checked; None: the optimizer's own loss of the image.
    image: None if there is none.
    features: (T, C); None if there are none.
    version: of the encoder that made the features; None if it is not known.
    """

    loss: Any
    image: Any = None
    features: Any = None
    version: str | None = None


def read_result(result: object) -> Result:
    """Parts of an `ImageLoss`, an image, a pair (loss, image), or (loss, None).

    Anything else is regarded as a loss.
    """
    if isinstance(result, ImageLoss):
        return Result(float(result), result.image, result.features, result.version)
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
