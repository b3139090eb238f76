"""The `vgg19` encoder: activations of a layer of VGG-19 (Simonyan and Zisserman 2014).

The network was trained to classify ImageNet.  The encoder reads torchvision's file and ignores its
classifier.  A token is one position of a layer's feature map after the ReLU.  Layers have the usual
names, relu<block>_<convolution>.  Each block halves the resolution: patches have 2^(block - 1)
pixels a side.
"""

from __future__ import annotations

import os
import re

import torch
from torch import Tensor

from fide_plugins.encoders.pretrained import backbones
from fide_plugins.encoders.pretrained.network import NetworkEncoder
from fide_plugins.errors import OptionError
from fide_plugins.runtime.devices import digest

__all__ = ["VGG19Encoder"]

_CONVOLUTIONS = (2, 2, 4, 4, 4)  # of each block
_WIDTHS = (64, 128, 256, 512, 512)
_HOW = (
    "; encoders.make('vgg19', download=True) fetches them once from "
    f"{backbones.VGG19.published.url}, 548 MB, and encoders.make('vgg19', weights=PATH) reads a "
    "file of yours; the encoder 'dense' needs none"
)


class VGG19Encoder(NetworkEncoder):
    """Activations of one layer of VGG-19.

    Parameters
    ----------
    variant
        the layer; by default the last one with patches of 16 x 16 pixels: 14 x 14 tokens of 512
        channels for an image of 224 x 224.
    weights
        torchvision's file; None: the file in PyTorch's cache.
    download
        download that file into the cache if it is missing.
    device
        device of the network.

    Raises
    ------
    OptionError
        there is no such layer.
    WeightsNotFoundError, WeightsMismatchError
        the file is missing, or does not hold this network.
    """

    name = "vgg19"

    def __init__(
        self,
        *,
        variant: str = "relu5_4",
        weights: str | os.PathLike[str] | None = None,
        download: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(device=device)
        block, self._layer = _find_layer(variant)
        self.patch, self.channels = 2 ** (block - 1), _WIDTHS[block - 1]
        network = backbones.load(backbones.VGG19, weights, download=download, how=_HOW)
        self.weights_digest = digest(network)
        self.version = f"vgg19-2-{variant}-{self.weights_digest}"
        self._network = network.to(self.device)

    def _features(self, images: Tensor) -> Tensor:
        (activations,) = self._network.taps(images, [self._layer])
        return activations.flatten(2).transpose(1, 2)  # (n, T, C)


def _find_layer(name: str) -> tuple[int, int]:
    """Block, from 1, and index of the layer in the whole network."""
    match = re.fullmatch(r"relu([1-5])_([1-4])", name)
    block, convolution = map(int, match.groups()) if match else (0, 0)
    if not 0 < convolution <= (_CONVOLUTIONS[block - 1] if block else 0):
        known = [f"relu{i}_{j}" for i, n in enumerate(_CONVOLUTIONS, 1) for j in range(1, n + 1)]
        raise OptionError(f"a layer of vgg19 is one of {', '.join(known)}, not {name!r}")
    before = sum(2 * n + 1 for n in _CONVOLUTIONS[: block - 1])  # and a pooling after each block
    return block, before + 2 * convolution - 1
