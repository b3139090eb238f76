"""VGG-19's activations as tokens, by random weights in the layout of torchvision's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fide_lab.pretrained import backbones
from fide_plugins import encoders
from fide_plugins.errors import OptionError, WeightsNotFoundError

RNG = np.random.default_rng(14)
LAYERS = {  # name: number in torchvision's `features`, pixels of a patch, channels
    "relu1_1": (1, 1, 64),
    "relu1_2": (3, 1, 64),
    "relu2_2": (8, 2, 128),
    "relu3_4": (17, 4, 256),
    "relu4_1": (20, 8, 512),
    "relu5_1": (29, 16, 512),
    "relu5_4": (35, 16, 512),
}


@pytest.mark.parametrize("layer", LAYERS)
def test_tokens_are_places_of_the_layer(layer: str, cached_weights: Path) -> None:
    number, patch, channels = LAYERS[layer]
    images = RNG.random((2, 32, 48, 3), dtype=np.float32)
    normalized = (images - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    x = torch.tensor(normalized, dtype=torch.float32).permute(0, 3, 1, 2)
    (activations,) = backbones.load(backbones.VGG19).taps(x, [number])
    encoder = encoders.make(f"vgg19:{layer}")
    tokens = encoder(images)
    assert encoder.shape(32, 48) == tokens.shape[1:] == (32 * 48 // patch**2, channels)
    row, column = 32 // patch - 1, 48 // patch // 2
    for i in range(2):
        torch.testing.assert_close(
            tokens[i, row * (48 // patch) + column],
            activations[i, :, row, column],
            atol=1e-4,
            rtol=1e-4,
        )
    assert tokens.min() == 0 < tokens.max()


def test_versions(cached_weights: Path) -> None:
    default, layer = encoders.make("vgg19"), encoders.make("vgg19:relu4_1")
    assert default.version.startswith("vgg19-2-relu5_4-") and layer.version != default.version


@pytest.mark.parametrize("layer", ["relu1_3", "relu6_1", "relu5_0", "conv1_1", "", "relu5_4x"])
def test_no_such_layer(layer: str) -> None:
    with pytest.raises(OptionError, match=r"one of relu1_1, .*relu5_4, not '"):
        encoders.make(f"vgg19:{layer}")


def test_without_weights(no_weights: Path) -> None:
    message = r"VGG-19 at .*vgg19-dcbb9e9d\.pth; .*download=True.*https://.*'dense' needs none"
    with pytest.raises(WeightsNotFoundError, match=message):
        encoders.make("vgg19")
    assert not no_weights.exists()
