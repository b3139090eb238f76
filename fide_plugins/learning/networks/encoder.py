"""A small convolutional encoder, trained together with its head; no pretrained weights.

Strided convolutions reduce the image to a map of at most 8 x 8 places, for heads that look at
places; one more and a linear layer make a vector of it, for the others.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.networks.trainable import linear, mean_and_variance

__all__ = ["Encoder"]

_PLACES = 8  # on the longer side of the map, at most
_CHANNELS = (48, 96, 128, 160, 192, 224)  # after each convolution
_TOP = 160  # channels of the last convolution
_SIDES = {4: 6, 2: 3}  # of a kernel, by the stride
_LARGE = 48  # pixels from which the first convolution has a stride of 4


class Encoder(nn.Module):
    """Images (B, 3, H, W) in [0, 1] -> map (B, places, channels) and vector (B, width).

    size: height and width of the images.  width: of the vector.

    Images are standardized by `mean` and `std`, see `standardize`, since what a parameter changes
    may be a small part of an image.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: tuple[int, int], width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(3, *size, dtype=torch.float32))
        self.register_buffer("std", torch.ones((), dtype=torch.float32))
        steps = _steps(max(size))
        channels = [3, *(_CHANNELS[min(i, len(_CHANNELS) - 1)] for i in range(len(steps)))]
        self.down = nn.ModuleList(
            _convolution(a, b, _SIDES[step], step, 1)
            for (a, b), step in zip(pairwise(channels), steps, strict=True)
        )
        self.channels = channels[-1]
        self.mix = _convolution(self.channels, self.channels, 1)
        self.top = _convolution(self.channels, _TOP, 3, 2, 1)
        with torch.no_grad():
            places = self._map(torch.zeros(1, 3, *size, dtype=torch.float32))
            inputs = self.top(places).numel()
        self.grid = (int(places.shape[2]), int(places.shape[3]))
        self.places = self.grid[0] * self.grid[1]
        self.project = linear(inputs, width)
        self.normalize = nn.LayerNorm(width, dtype=torch.float32)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def standardize(self, images: Tensor) -> None:
        """Take mean image and contrast from images (B, 3, H, W), on any device."""
        mean, variance = mean_and_variance(images)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def _map(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, channels, h, w)."""
        h = (images - self.mean) / self.std
        for layer in self.down:
            h = F.relu(layer(h))
        return h + F.relu(self.mix(h))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, places, channels) and vector (B, width)."""
        places = self._map(images.contiguous(memory_format=torch.channels_last))
        top = F.relu(self.top(places))
        vector = F.gelu(self.normalize(self.project(top.flatten(1))))
        return places.flatten(2).transpose(1, 2), vector


_convolution = partial(nn.Conv2d, dtype=torch.float32)  # whatever PyTorch's default is


def _steps(side: int) -> list[int]:
    """Strides of the convolutions that reduce a side to at most `_PLACES`; at least one."""
    steps = [4 if side >= _LARGE else 2]
    while side > _PLACES * math.prod(steps):
        steps.append(2)
    return steps
