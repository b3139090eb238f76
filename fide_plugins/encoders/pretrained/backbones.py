"""The convolutional parts of AlexNet (Krizhevsky 2014) and VGG-19 (Simonyan and Zisserman 2014).

Layers have the order and the names (``features.N.weight``, ``features.N.bias``) of torchvision's
models, so that its published files fit; torchvision itself is not needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fide_plugins.encoders.pretrained import weights
from fide_plugins.encoders.pretrained.weights import Published

_URL = "https://download.pytorch.org/models/"


@dataclass(frozen=True, slots=True)
class Architecture:
    """The convolutional part of a network: its layers, and where their weights are published."""

    published: Published
    layers: Callable[[], list[nn.Module]]


class Backbone(nn.Module):
    """A sequence of layers."""

    def __init__(self, layers: Sequence[nn.Module]) -> None:
        super().__init__()
        self.features = nn.Sequential(*layers)

    def taps(self, images: Tensor, after: Sequence[int]) -> list[Tensor]:
        """Outputs of the layers with these increasing indices for images (n, 3, H, W)."""
        found, wanted = [], set(after)
        for number in range(max(after) + 1):
            images = self.features[number](images)
            if number in wanted:
                found.append(images)
        return found


def load(
    architecture: Architecture,
    given: str | os.PathLike[str] | None = None,
    *,
    download: bool = False,
    how: str = "",
) -> Backbone:
    """Network with its published weights, from a user's file or from PyTorch's cache.

    Raises what `Published.find`, `weights.read` and `weights.fill` raise.
    """
    path = architecture.published.find(given, download=download, how=how)
    state = weights.read(path)
    with torch.device("meta"):
        network = Backbone(architecture.layers())
    weights.fill(network, state, path, ignored=("classifier.",))
    return network


def _alexnet() -> list[nn.Module]:
    return [
        *_convolution(3, 64, 11, stride=4, padding=2),
        nn.MaxPool2d(3, 2),
        *_convolution(64, 192, 5, padding=2),
        nn.MaxPool2d(3, 2),
        *_convolution(192, 384, 3, padding=1),
        *_convolution(384, 256, 3, padding=1),
        *_convolution(256, 256, 3, padding=1),
    ]


def _vgg19() -> list[nn.Module]:
    layers: list[nn.Module] = []
    channels = 3
    for count, width in zip((2, 2, 4, 4, 4), (64, 128, 256, 512, 512), strict=True):
        for _ in range(count):
            layers += _convolution(channels, width, 3, padding=1)
            channels = width
        layers.append(nn.MaxPool2d(2))
    return layers


def _convolution(
    channels: int, width: int, side: int, *, stride: int = 1, padding: int = 0
) -> list[nn.Module]:
    return [nn.Conv2d(channels, width, side, stride, padding), nn.ReLU()]


def _published(network: str, stem: str, sha256: str) -> Published:
    file = f"{stem}-{sha256}.pth"
    return Published(network, file, _URL + file, sha256)


ALEXNET = Architecture(_published("AlexNet", "alexnet-owt", "7be5be79"), _alexnet)
VGG19 = Architecture(_published("VGG-19", "vgg19", "dcbb9e9d"), _vgg19)
