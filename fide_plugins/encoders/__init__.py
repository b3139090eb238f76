"""Encoders: images to tokens.

An encoder turns n images into a float32 tensor (n, T, C): T tokens, each the C features of one
patch.  T and C depend only on the image size.  Features are comparable if name and version of the
encoders are equal.

    >>> from fide_plugins import encoders
    >>> encoders.names()
    ['dense', 'dinov3', 'efficientnet', 'patch', 'texture', 'vgg19']
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import WeightsNotFoundError
from fide_plugins.runtime.registry import Registry

if TYPE_CHECKING:
    import torch

    from fide_plugins.encoders.base import PatchEncoder

__all__ = ["WeightsNotFoundError", "make", "names", "register", "uses_network"]

_REGISTRY: Registry[Any] = Registry("encoder")


def names() -> list[str]:
    """Names of all encoders, sorted."""
    return _REGISTRY.names()


def make(name: str, *, device: str | torch.device = "cpu", **options: object) -> PatchEncoder:
    """Encoder of that name, on that device (``"auto"``: CUDA if it is available).

    The name may be followed by a variant, ``"vgg19:relu4_1"`` or ``"dinov3:FOLDER"``.

    options: arguments of the encoder's class.

    Raises `UnknownNameError`, `OptionError` for an option that the encoder does not have (a factory
    of yours needs `device`), `DeviceError`, or what the encoder itself raises.
    """
    from fide_plugins.encoders.base import PatchEncoder

    made = _REGISTRY.make(name, device=device, **options)
    if isinstance(made, PatchEncoder):
        return made
    from fide_plugins.encoders.own import OwnEncoder

    return OwnEncoder(made, name=name, device=device)


def uses_network(name: str) -> bool:
    """Whether a GPU makes the encoder of that `name` faster.

    Its class says so; of a function it is assumed.  Raises `UnknownNameError`.
    """
    factory = _REGISTRY.resolve(name.partition(":")[0])
    return bool(getattr(factory, "uses_network", True))


def register(name: str, factory: Callable[..., Callable[..., object]] | str) -> None:
    """Register `factory(device=..., **options)`, or the factory at ``"module:attribute"``.

    It returns a `PatchEncoder`, or any callable of a batch of images, see `encoders.own`.  A
    checkpoint holds the encoder by its name.
    """
    _REGISTRY.register(name, factory)


register("dense", "fide_plugins.encoders.dense:DenseEncoder")
register("dinov3", "fide_lab.pretrained.dinov3:DinoEncoder")
register("efficientnet", "fide_lab.pretrained.efficientnet:EfficientNetEncoder")
register("patch", "fide_plugins.encoders.patch:RawPatchEncoder")
register("texture", "fide_plugins.encoders.texture:TextureEncoder")
register("vgg19", "fide_lab.pretrained.vgg19:VGG19Encoder")
