"""Which device is meant, on machines with GPUs and without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from fide_plugins import encoders
from fide_plugins.fide import FIDE
from fide_plugins.runtime.devices import (
    batch_size,
    digest,
    in_batches,
    repeatable,
    resolve_device,
)

TARGET = np.zeros((32, 32, 3), np.float32)


@pytest.fixture
def second_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two GPUs, of which this thread uses the second."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch, "empty", lambda *shape, device: None)


@pytest.mark.usefixtures("second_gpu")
@pytest.mark.parametrize(
    ("asked", "meant"),
    [("auto", "cuda:1"), ("cuda", "cuda:1"), ("cuda:0", "cuda:0"), ("cpu", "cpu")],
)
def test_a_gpu_without_a_number_is_the_one_in_use(asked: str, meant: str) -> None:
    assert resolve_device(asked) == torch.device(meant)
    assert resolve_device(torch.device("cuda")) == torch.device("cuda:1")
    if asked != "auto":
        assert resolve_device(asked, for_network=False) == torch.device(meant)


@pytest.mark.parametrize(
    ("options", "meant"),
    [
        ({"preset": "balanced"}, "cpu"),
        ({"preset": "fast"}, "cpu"),
        ({"preset": "accurate", "encoder": "patch"}, "cpu"),
        ({"preset": "balanced", "device": "cuda"}, "cuda:1"),
        ({"preset": "balanced", "encoder": "vgg19"}, "cuda:1"),
        ({"preset": "balanced", "encoder": "vgg19:relu2_1"}, "cuda:1"),
        ({"preset": "balanced", "encoder": "vgg19", "device": "cpu"}, "cpu"),
        ({"preset": "paper"}, "cuda:1"),
        ({"preset": "balanced", "proposer": "diffusion"}, "cuda:1"),
    ],
)
@pytest.mark.usefixtures("second_gpu")
def test_where_an_optimizer_computes(
    options: dict[str, Any], meant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Made(Exception):
        """Where the encoder goes."""

    def make(name: str, *, device: Any) -> Any:
        raise Made(str(device))

    monkeypatch.setattr(encoders, "make", make)
    with pytest.raises(Made, match=f"^{meant}$"):
        FIDE(6, TARGET, **options)


@pytest.mark.parametrize("before", [(False, True), (True, False)])
def test_settings_of_cudnn_are_as_before_after_what_is_to_be_repeatable(
    before: tuple[bool, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """PyTorch keeps them without a GPU, too."""
    cudnn = torch.backends.cudnn
    monkeypatch.setattr(cudnn, "deterministic", before[0])
    monkeypatch.setattr(cudnn, "benchmark", before[1])
    with pytest.raises(KeyError), repeatable(torch.device("cuda")):
        assert (cudnn.deterministic, cudnn.benchmark) == (True, False)
        raise KeyError
    assert (cudnn.deterministic, cudnn.benchmark) == before
    with repeatable(torch.device("cpu")):
        assert (cudnn.deterministic, cudnn.benchmark) == before


# -- batches of one size ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "on_cpu", "on_gpu"),
    [(512, 1, 6), (224, 1, 32), (112, 2, 128), (80, 3, 250), (64, 4, 256), (16, 4, 256)],
)
def test_a_single_image_pays_for_few(side: int, on_cpu: int, on_gpu: int) -> None:
    assert batch_size(torch.device("cpu"), side, side) == on_cpu
    assert batch_size(torch.device("cuda"), side, side) == on_gpu


@pytest.mark.parametrize("n", [0, 1, 3, 4, 7])
def test_the_network_sees_one_size(n: int) -> None:
    seen: list[int] = []

    def network(x: Tensor) -> Tensor:
        seen.append(len(x))
        return x.sum(dim=1) + 1

    images = torch.arange(2.0 * n).reshape(n, 2)
    assert torch.equal(in_batches(network, images, 3), images.sum(dim=1) + 1)
    assert seen == [3] * max(-(-n // 3), 1)


# -- other weights, names of weights or settings have another digest -------------------------------


def network(second: float = 1.0) -> nn.Module:
    """A network of two numbers."""
    made = nn.Linear(2, 1, bias=False)
    made.weight.data = torch.tensor([[1.0, second]])
    return made


def test_it_is_of_names_and_values() -> None:
    first = digest(network())
    assert len(first) == 8 and digest(network()) == first
    assert digest(network(1.0000001)) != first
    assert digest(nn.Sequential(network())) != first  # "0.weight"
