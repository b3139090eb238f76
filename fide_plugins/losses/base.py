"""Base class of losses: the target, validation, one image at a time; `mse`; a user's own loss.

    def loss(images):              # float32 (n, H, W, 3) in [0, 1], a copy
        return values              # (n,) real numbers; array, tensor or list; the lower the better

For a list of targets it gets a list of such batches, one for each view.  The value of an image must
not depend on the rest of its batch.  NaN and infinity rank last, but not for the target itself.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

import numpy as np

from fide_plugins.errors import LossError
from fide_plugins.runtime.registry import name_of, tried_on
from fide_plugins.runtime.threads import one_thread, user_threads
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_batch, as_target

__all__ = [
    "CallableLoss",
    "ImageLoss",
    "LossOfTarget",
    "LossWithoutTarget",
    "MeanSquaredError",
    "as_losses",
    "check_loss",
    "loss_not_stored",
]


class ImageLoss(Protocol):
    """Interface of a loss for optimizers."""

    @property
    def name(self) -> str:
        """Name, for messages and tables."""

    @property
    def version(self) -> str | None:
        """Changes whenever the loss of an image changes; None: unknown."""

    @property
    def spec(self) -> str | None:
        """Name from which `losses.make` makes the same loss; None if there is none."""

    def __call__(self, images: object) -> Float64:
        """Losses (n,) of images, after validation."""

    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of a canonical batch, without further checks."""


class LossOfTarget(ABC):
    """Base class of a loss for one target.

    A subclass defines `name`, `version` and `_distance`, and prepares `self.target` once.  Images
    are processed one by one, in float64 or with kernels of a fixed shape.  So the value of an image
    is the same, bit for bit, in every batch, and memory does not grow with the batch.
    """

    name: str
    """Name in `fide_plugins.losses`."""
    version: str
    """Changes whenever the loss of an image changes."""
    spec: str | None = None
    """Name from which `losses.make` makes the same loss; None if it was made with options."""
    weighs_pixels: bool = False
    """Whether its argument and attribute `weights` are those of pixels, (H, W) or None."""
    of_places: bool = True
    """Whether it compares what is at the same place; then light and clutter can be set aside."""

    def __init__(self, target: object) -> None:
        self.target = as_target(target)
        self.target.flags.writeable = False

    def __call__(self, images: object) -> Float64:
        """Losses (n,) >= 0, zero for an image that equals the target.

        images: (n, H, W, C) or any other input of `as_batch`, of the target's size; `ImageError`
            otherwise.
        """
        return self.compute(as_batch(images, self.target.shape))

    @one_thread
    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of a canonical batch (n, H, W, 3), without further checks."""
        with np.errstate(under="ignore"):  # squares of tiny differences
            return np.fromiter((self._distance(image) for image in batch), np.float64, len(batch))

    def check_target(self, target: object) -> None:
        """Raise `LossError` unless this loss was made for `target`."""
        other = as_target(target)
        if not np.array_equal(other, self.target):
            raise LossError(
                f"the loss {self.name!r} was made for another target, of shape "
                f"{self.target.shape}, than that of the optimizer, of shape {other.shape}; make it "
                f"with losses.make({self.name!r}, target)"
            )

    @abstractmethod
    def _distance(self, image: Float32) -> float:
        """Distance of a canonical image (H, W, 3) from the target."""


class MeanSquaredError(LossOfTarget):
    """sum (image - target)^2 / (3 H W), each difference and the sum in float64.

    weights: (H, W) w >= 0, not all of them 0: sum w (image - target)^2 / (3 sum w).
    """

    name = "mse"
    version = "mse-2"  # 1 differs in the last digits
    weighs_pixels = True

    def __init__(self, target: object, *, weights: Float32 | None = None) -> None:
        super().__init__(target)
        self.weights = weights

    def _distance(self, image: Float32) -> float:
        if self.weights is not None:
            squared = np.square(np.subtract(image, self.target, dtype=np.float64)).mean(axis=-1)
            return float(np.average(squared, weights=self.weights))
        from fide_plugins.runtime.opencv import cv2  # imported late: it takes a tenth of a second

        return float(cv2.norm(image, self.target, cv2.NORM_L2SQR)) / image.size


class CallableLoss:
    """A user's function of images, with checks of its input and its values.

    spec: name under which it is registered; None: it is not.
    """

    def __init__(
        self, function: Callable[..., object], target: object, spec: str | None = None
    ) -> None:
        self.name, self.spec = name_of(function) if spec is None else spec, spec
        version = getattr(function, "version", None)
        self.version = None if version is None else str(version)
        self._function = function
        self._shape = as_target(target).shape

    def __call__(self, images: object) -> Float64:
        """Losses (n,) of images, after validation."""
        return self.compute(as_batch(images, self._shape))

    @user_threads
    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of a canonical batch; the function gets a copy, which it may modify."""
        return as_losses(self._function(batch.copy()), len(batch), f"the loss {self.name!r}")


class LossWithoutTarget:
    """The loss of an optimizer without a target: it has a name, and computes nothing.

    spec: its name in `fide_plugins.losses`; None: it is a user's own.
    """

    version = None

    def __init__(self, name: str, spec: str | None = None) -> None:
        self.name, self.spec = name, spec

    def __call__(self, images: object) -> Float64:
        """Raise LossError."""
        raise LossError(
            f"there is no target to compare images with by the loss {self.name!r}; tell losses"
        )

    def compute(self, batch: Float32) -> Float64:
        """Raise LossError."""
        return self(batch)


def as_losses(values: object, n: int, what: str = "losses") -> Float64:
    """Float64 copy (n,) of loss values, which may be NaN or infinite.

    Raises LossError (a ValueError) unless they are n real numbers.
    """
    if hasattr(values, "detach"):  # a torch tensor, perhaps on another device
        values = values.detach().cpu()
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as e:
        raise LossError(f"{what} must be {n} numbers, one per image: {e}") from e
    if array.dtype.kind not in "fiub":
        raise LossError(f"{what} must be real numbers, got {array.dtype} ({type(values).__name__})")
    if array.shape == (n, 1) or (n == 1 and array.shape == ()):
        array = array.reshape(n)
    if array.shape != (n,):
        raise LossError(f"{what} must be {n} numbers, one per image, got shape {array.shape}")
    return array.astype(np.float64)


def check_loss(loss: ImageLoss, target: Float32) -> None:
    """Try a loss on the target (H, W, 3), where it must be finite, and its negative; LossError."""
    what = f"the loss {loss.name!r}"
    together = tried_on(target, loss.compute, what, LossError)
    if not np.isfinite(together[0]):
        raise LossError(f"{what} must be finite for the target itself, but it is {together[0]}")


def loss_not_stored(images: object) -> object:
    """Loss of a loaded optimizer whose original loss was a callable; raises LossError."""
    raise LossError(
        "this optimizer was saved with a callable as its loss, which a checkpoint cannot hold; "
        "give it again, load(path, loss=...), or tell losses"
    )
