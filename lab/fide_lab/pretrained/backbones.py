"""The convolutional parts of AlexNet (Krizhevsky 2014) and VGG-19 (Simonyan and Zisserman 2014).

Layers have the order and the names (``features.N.weight``, ``features.N.bias``) of torchvision's
models, so that its published files fit; torchvision itself is not needed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from fide_lab.pretrained import weights
from fide_lab.pretrained.weights import Published

_URL = "https://download.pytorch.org/models/"
_ALEX, _VGG = "alexnet-owt-7be5be79.pth", "vgg19-dcbb9e9d.pth"
ALEXNET = Published("AlexNet", _ALEX, _URL + _ALEX, "7be5be79")
VGG19 = Published("VGG-19", _VGG, _URL + _VGG, "dcbb9e9d")
_BLOCKS = (2, 64), (2, 128), (4, 256), (4, 512), (4, 512)  # convolutions, and their width
_PLANS: dict[str, list[tuple[int, ...]]] = {
    "AlexNet": [
        (64, 11, 4, 2), (3,), (192, 5, 1, 2), (3,), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)
    ],
    "VGG-19": [one for count, width in _BLOCKS for one in (*[(width, 3, 1, 1)] * count, (2,))],
}  # fmt: skip
"""Width, side, stride and padding of a convolution with a ReLU; the side of a pooling."""


class Backbone(nn.Module):
    """A sequence of layers, those of a plan."""

    def __init__(self, plan: Sequence[tuple[int, ...]]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for one in plan:
            if len(one) == 1:
                layers.append(nn.MaxPool2d(one[0], 2))
                continue
            width, side, stride, padding = one
            layers += [nn.Conv2d(channels, width, side, stride, padding), nn.ReLU()]
            channels = width
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
    published: Published,
    given: str | os.PathLike[str] | None = None,
    *,
    download: bool = False,
    how: str = "",
) -> Backbone:
    """`ALEXNET` or `VGG19` with its weights, from a user's file or from PyTorch's cache.

    Raises what `Published.find`, `weights.read` and `weights.fill` raise.
    """
    path = published.find(given, download=download, how=how)
    state = weights.read(path)
    with torch.device("meta"):
        network = Backbone(_PLANS[published.network])
    weights.fill(network, state, path, ignored=("classifier.",))
    return network
