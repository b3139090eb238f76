"""What separates a picture from a render: exposure, noise, a small blur.

Each change is made to half of the images of a batch, to each of them in its own way.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["augmented"]

_EXPOSURE = 0.05  # relative, at most
_NOISE = 0.02  # standard deviation, at most
_BLUR = 0.5  # fraction of a blurred image, at most
_NOISES = 16  # noise images of a batch, used with either sign: random numbers take time


def augmented(images: Tensor, generator: torch.Generator) -> Tensor:
    """Images (B, 3, H, W) in [0, 1] with small changes; same generator, same changes."""
    images = images.clone()

    def half(scale: float) -> tuple[Tensor, Tensor]:
        """Which images are changed, (m,), and by how much, uniform in [0, scale], (m, 1, 1, 1)."""
        which = torch.randperm(len(images), generator=generator)[: len(images) // 2]
        return which, scale * torch.rand(len(which), 1, 1, 1, generator=generator)

    which, fraction = half(_BLUR)
    sharp = images[which]
    blurred = F.avg_pool2d(sharp, 3, 1, 1, count_include_pad=False)
    images[which] = torch.lerp(sharp, blurred, fraction)
    which, change = half(2 * _EXPOSURE)
    images[which] *= 1 + change - _EXPOSURE
    which, deviation = half(_NOISE)
    images[which] += deviation * _noise(which, images.shape[1:], generator)
    return images.clamp_(0.0, 1.0)


def _noise(which: Tensor, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Standard normal noise for the images `which` (m,): (m, 3, H, W)."""
    few = torch.randn(_NOISES, *shape, generator=generator)
    drawn = torch.randint(0, 2 * _NOISES, which.shape, generator=generator)
    return torch.cat([few, -few])[drawn]
