"""Losses: distances of images from the target.

A loss is made for one target and called with images; it returns a float64 array (n,), zero for an
image that equals the target.  The value of an image does not depend on the rest of its batch.

    >>> import numpy as np
    >>> from fide_plugins import losses
    >>> losses.names()
    ['loi', 'lpips', 'mse', 'perceptual', 'texture']
    >>> mse = losses.make("mse", np.zeros((8, 8, 3)))
    >>> mse(np.full((2, 8, 8, 3), 0.5))
    array([0.25, 0.25])

Any callable from images to n numbers can serve as a loss; :func:`resolve` wraps it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from fide_plugins.errors import LossError, WeightsNotFoundError
from fide_plugins.runtime.registry import Registry

if TYPE_CHECKING:
    import torch

    from fide_plugins.losses.base import ImageLoss, LossOfTarget

__all__ = [
    "WeightsNotFoundError",
    "knows",
    "make",
    "names",
    "register",
    "resolve",
    "takes_weights",
]

_REGISTRY: Registry[Any] = Registry("loss")


def names() -> list[str]:
    """Names of all losses, sorted."""
    return _REGISTRY.names()


def knows(name: str) -> bool:
    """Whether `make` knows that name, without its variant."""
    return _REGISTRY.knows(name)


def takes_weights(name: str) -> bool:
    """Whether the loss of that name weighs pixels itself, by the option `weights` (H, W) of `make`.

    Its class says so: the option of another loss may mean anything, such as a file.
    """
    from fide_plugins.losses.base import LossOfTarget

    factory = _REGISTRY.resolve(name.partition(":")[0])
    return isinstance(factory, type) and issubclass(factory, LossOfTarget) and factory.weighs_pixels


def make(name: str, target: object, **options: object) -> LossOfTarget:
    """Loss of that name for `target`, any input of `as_target`.

    options: arguments of the loss's class, such as `device` of "lpips".

    Raises `UnknownNameError`, `OptionError` for an option that the loss does not have,
    `ImageError`, or what the loss itself raises, such as `WeightsNotFoundError`.
    """
    from fide_plugins.losses.base import CallableLoss, LossOfTarget

    loss = _REGISTRY.make(name, target, **options)
    spec = None if set(options) - {"device"} else name
    if not isinstance(loss, LossOfTarget):  # a callable, with the same interface
        return cast("LossOfTarget", CallableLoss(loss, target, spec))
    loss.spec = spec
    return loss


def register(name: str, factory: Callable[..., Callable[..., object]] | str) -> None:
    """Register `factory(target, **options)`, or the factory at ``"module:attribute"``.

    It returns a `LossOfTarget`, or any callable of a batch of images (n, H, W, 3) that returns (n,)
    numbers.  A checkpoint holds the loss by its name.
    """
    _REGISTRY.register(name, factory)


def resolve(
    loss: str | Callable[..., object] | None,
    target: object,
    *,
    device: str | torch.device | None = None,
) -> ImageLoss:
    """Loss from a name, None for "mse", or a callable images -> (n,).

    target: None makes a loss that has its name, and raises LossError for images.  A loss that was
        made must be one for this very target.
    device: on which a loss given by name computes, if it can; None: where it likes.

    Raises `LossError` for a loss of another target, or what is no loss; what `make` raises for a
    name.
    """
    from fide_plugins.losses.base import CallableLoss, LossOfTarget, LossWithoutTarget
    from fide_plugins.runtime.registry import name_of

    if loss is None or isinstance(loss, str):
        name = "mse" if loss is None else loss
        if target is None and knows(name):
            return LossWithoutTarget(name, name)
        on = {"device": device} if device is not None and _REGISTRY.takes(name, "device") else {}
        return make(name, target, **on)
    if isinstance(loss, LossOfTarget) and target is not None:
        loss.check_target(target)
        return loss
    if isinstance(loss, CallableLoss):
        return loss
    if not callable(loss):
        raise LossError(
            f"a loss is a name ({', '.join(names())}), a callable images -> (n,), or None, "
            f"got {loss!r}"
        )
    return LossWithoutTarget(name_of(loss)) if target is None else CallableLoss(loss, target)


register("loi", "fide_plugins.losses.loi:LocallyOrderlessLoss")
register("lpips", "fide_lab.pretrained.lpips:LPIPSLoss")
register("mse", "fide_plugins.losses.base:MeanSquaredError")
register("perceptual", "fide_plugins.losses.perceptual:PerceptualLoss")
register("texture", "fide_plugins.losses.texture:TextureLoss")
