"""The networks, layer by layer, against functions of PyTorch written down from the published files.

A layer is written as its kind: c4/2 a convolution of stride 4 and padding 2, r a ReLU, p2 and p3 a
pooling of that side (stride 2).
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fide_lab.pretrained import backbones, weights
from fide_lab.pretrained.weights import Published
from fide_plugins.errors import WeightsMismatchError, WeightsNotFoundError

C = "c1/1 r "
RECIPES: dict[str, tuple[Published, str, str]] = {
    "alexnet": (
        backbones.ALEXNET,
        "alexnet-owt-7be5be79.pth",
        "c4/2 r p3 c1/2 r p3 " + 3 * C,
    ),
    "vgg19": (
        backbones.VGG19,
        "vgg19-dcbb9e9d.pth",
        2 * (2 * C + "p2 ") + 3 * (4 * C + "p2 "),
    ),
}


def run(recipe: str, state: dict[str, Tensor], x: Tensor) -> list[Tensor]:
    """What each layer gives, in double precision."""
    x, outputs = x.double(), []
    for number, layer in enumerate(recipe.split()):
        if layer[0] == "c":
            weight, bias = (state[f"features.{number}.{k}"].double() for k in ("weight", "bias"))
            x = F.conv2d(x, weight, bias, *map(int, layer[1:].split("/")))
        elif layer == "r":
            x = x.clamp(min=0)
        else:
            x = F.max_pool2d(x, int(layer[1]), 2)
        outputs.append(x)
    return outputs


@pytest.mark.parametrize("name", RECIPES)
def test_every_layer(name: str, cached_weights: Path) -> None:
    architecture, file, recipe = RECIPES[name]
    network = backbones.load(architecture)
    images = torch.randn(2, 3, 36, 44, generator=torch.Generator().manual_seed(0))
    state = weights.read(cached_weights / file)
    outputs = run(recipe, state, images)
    layers = range(len(outputs) - name.startswith("vgg"))  # the last pooling is nobody's
    taps = network.taps(images, layers)
    for tap, expected in zip(taps, outputs, strict=False):
        scale = expected.abs().max().item()
        torch.testing.assert_close(tap.double(), expected, atol=1e-5 * scale, rtol=0)
    some = [layers[1], layers[-1]]
    for tap, again in zip((taps[i] for i in some), network.taps(images, some), strict=True):
        assert torch.equal(tap, again)


def test_no_file(no_weights: Path) -> None:
    with pytest.raises(WeightsNotFoundError, match=r"AlexNet at .*alexnet-owt-7be5be79\.pth; do"):
        backbones.load(backbones.ALEXNET, how="; do this")
    with pytest.raises(WeightsNotFoundError, match=r"VGG-19 at mine\.pth"):
        backbones.load(backbones.VGG19, "mine.pth")


def test_another_network(cached_weights: Path) -> None:
    file = cached_weights / "alexnet-owt-7be5be79.pth"
    with pytest.raises(WeightsMismatchError, match=r"(?s)alexnet.*\.pth belongs to another"):
        backbones.load(backbones.VGG19, file)
