"""The `vgg19` encoder: activations of a layer of VGG-19 (Simonyan and Zisserman 2014).

The network was trained to classify ImageNet.  The encoder reads torchvision's file and ignores its
classifier.  A token is one position of a layer's feature map after the ReLU.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor

from fide_lab.pretrained import backbones
from fide_lab.pretrained.network import NetworkEncoder
from fide_plugins.errors import OptionError
from fide_plugins.runtime.devices import digest

_CONVOLUTIONS = (2, 2, 4, 4, 4)  # of each block
_WIDTHS = (64, 128, 256, 512, 512)
# Name of a layer: its block, and its index; a pooling follows each block.
_LAYERS = {
    f"relu{block}_{i + 1}": (block, sum(2 * n + 1 for n in _CONVOLUTIONS[: block - 1]) + 2 * i + 1)
    for block, count in enumerate(_CONVOLUTIONS, 1)
    for i in range(count)
}
_HOW = (
    "; encoders.make('vgg19', download=True) fetches them once from "
    f"{backbones.VGG19.url}, 548 MB, and encoders.make('vgg19', weights=PATH) reads a "
    "file of yours; the encoder 'dense' needs none"
)


class VGG19Encoder(NetworkEncoder):
    """Activations of one layer of VGG-19.

    variant: the layer, relu<block>_<convolution>, of patches of 2^(block - 1) pixels a side; by
        default the last one: 14 x 14 tokens of 512 channels for an image of 224 x 224.
    weights: torchvision's file; None: the file in PyTorch's cache.
    download: download that file into the cache if it is missing.

    Raises OptionError, WeightsNotFoundError or WeightsMismatchError.
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
        if variant not in _LAYERS:
            raise OptionError(f"a layer of vgg19 is one of {', '.join(_LAYERS)}, not {variant!r}")
        block, self._layer = _LAYERS[variant]
        self.patch, self.channels = 2 ** (block - 1), _WIDTHS[block - 1]
        network = backbones.load(backbones.VGG19, weights, download=download, how=_HOW)
        self.weights_digest = digest(network)
        self.version = f"vgg19-2-{variant}-{self.weights_digest}"
        self._network = network.to(self.device)

    def _features(self, images: Tensor) -> Tensor:
        (activations,) = self._network.taps(images, [self._layer])
        return activations.flatten(2).transpose(1, 2)  # (n, T, C)
