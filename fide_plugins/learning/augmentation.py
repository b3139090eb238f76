"""What changes renders while they are learned: what separates a photograph from a render.

The changes are small: a large one would change what the parameters mean.  Each is made to a share
of a batch, by kornia; the numbers are drawn here, since its modules draw from a global generator.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import torch
from torch import Tensor

from fide_plugins.runtime.machine import missing

_BLUR = 0.2, 0.8  # standard deviation of a Gaussian of 3 x 3 pixels, in pixels
_SHIFT = 0.5  # along each axis, in pixels, at most
_EXPOSURE = 0.05  # relative, at most
_BALANCE = 0.03  # of each color, relative, at most
_SATURATION = 0.1  # relative, at most
_NOISE = 0.02  # standard deviation, at most
_OCCLUDED = 0.3  # side of what is in front, of the image's, at most


Change: TypeAlias = Callable[..., Tensor]
"""Images (n, 3, H, W), more tensors, and a generator -> images."""


def augmented(images: Tensor, generator: torch.Generator, augment: str = "photograph") -> Tensor:
    """Images (B, 3, H, W) in [0, 1] with small changes, as one of `AUGMENT`, by the generator."""
    images = images.clone()
    for change, share in _CHANGES[augment]:
        change_some(images, change, share, generator)
    return images.clamp_(0.0, 1.0)


def change_some(
    images: Tensor, change: Change, share: float, generator: torch.Generator, *others: Tensor
) -> None:
    """Change a share of the images (B, 3, H, W) in place; others: (B, ...), what `change` needs."""
    every = torch.randperm(len(images), generator=generator, device=generator.device)
    which = every[: int(share * len(images))]
    if len(which):
        some = (one.index_select(0, which) for one in (images, *others))
        images.index_copy_(0, which, change(*some, generator))


def uniform(n: int, values: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    """Numbers (n, values)."""
    drawn = torch.rand(n, values, generator=generator, device=generator.device, dtype=torch.float32)
    return low + (high - low) * drawn


def in_front(images: Tensor, generator: torch.Generator) -> Tensor:
    """With one rectangle of one color, anywhere, also in part outside."""
    n, _, height, width = images.shape
    center, color = (uniform(n, k, 0.0, 1.0, generator) for k in (2, 3))
    half = uniform(n, 2, 0.0, _OCCLUDED / 2, generator)
    inside = [
        (middles(side, images.device) - center[:, i : i + 1]).abs() < half[:, i : i + 1]
        for i, side in enumerate((height, width))
    ]
    hidden = inside[0][:, None, :, None] & inside[1][:, None, None, :]
    return torch.where(hidden, color[:, :, None, None], images)


def middles(pixels: int, device: torch.device) -> Tensor:
    """Of pixels along a side, in [0, 1]."""
    return (torch.arange(pixels, device=device, dtype=torch.float32) + 0.5) / pixels


def _shifted(images: Tensor, generator: torch.Generator) -> Tensor:
    shift = uniform(len(images), 2, -_SHIFT, _SHIFT, generator)
    from kornia.geometry import translate

    moved: Tensor = translate(images, shift, padding_mode="border")
    return moved


def out_of_focus(
    images: Tensor, generator: torch.Generator, deviations: tuple[float, float], pixels: int
) -> Tensor:
    """Behind Gaussians of `pixels` x `pixels`, with standard deviations of that range."""
    sigma = uniform(len(images), 1, *deviations, generator).expand(-1, 2)
    from kornia.filters import gaussian_blur2d

    soft: Tensor = gaussian_blur2d(images, pixels, sigma, border_type="replicate")
    return soft


def _exposed(images: Tensor, generator: torch.Generator) -> Tensor:
    n = len(images)
    gain = 1 + uniform(n, 1, -_EXPOSURE, _EXPOSURE, generator)
    balance = 1 + uniform(n, 3, -_BALANCE, _BALANCE, generator)
    return images * (gain * balance)[:, :, None, None]


def _saturated(images: Tensor, generator: torch.Generator) -> Tensor:
    factor = 1 + uniform(len(images), 1, -_SATURATION, _SATURATION, generator)[:, 0]
    from kornia.enhance import adjust_saturation_with_gray_subtraction

    changed: Tensor = adjust_saturation_with_gray_subtraction(images, factor)
    return changed


def noisy(images: Tensor, generator: torch.Generator, most: float) -> Tensor:
    """With noise of a standard deviation up to `most`."""
    deviation = uniform(len(images), 1, 0.0, most, generator)[:, :, None, None]
    noise = torch.randn(
        images.shape, generator=generator, device=generator.device, dtype=images.dtype
    )
    return images + deviation * noise


_FOCUS = partial(out_of_focus, deviations=_BLUR, pixels=3), 1 / 2
_GRAIN = partial(noisy, most=_NOISE), 1 / 2
_CHANGES: dict[
    str, tuple[tuple[Change, float], ...]
] = {  # in the order of what happens: the scene, the lens, the sensor
    "none": (),
    "render": (_FOCUS, _GRAIN),
    "photograph": (
        (in_front, 1 / 4),
        (_shifted, 1 / 2),
        _FOCUS,
        (_exposed, 1 / 2),
        (_saturated, 1 / 2),
        _GRAIN,
    ),
}

AUGMENT = tuple(_CHANGES)
"""Names of how much is changed: nothing, what two renders differ in, what a photograph does."""


def check_installed(augment: str) -> None:
    """Raise DependencyError (an ImportError) where kornia is missing, and `augment` needs it."""
    if augment == "none":
        return
    try:
        import kornia  # noqa: F401
    except ImportError as error:
        remedy = 'changes of renders need kornia; leave them out with augment="none", or'
        raise missing("learn", f"{remedy} install it") from error
