"""Which device is meant, on machines with GPUs and without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import encoders
from fide_plugins.fide import FIDE
from fide_plugins.runtime import devices
from fide_plugins.runtime.devices import repeatable, resolve_device

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


@pytest.mark.usefixtures("second_gpu")
def test_auto_without_a_network_is_the_cpu() -> None:
    assert resolve_device("auto", for_network=False) == torch.device("cpu")


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


def test_a_network_is_what_a_gpu_makes_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions that somebody registered are taken for one."""
    monkeypatch.setattr(encoders._REGISTRY, "_factories", dict(encoders._REGISTRY._factories))
    encoders.register("own", lambda device: encoders.make("dense", device=device))
    network = {name: encoders.uses_network(name) for name in ("dense", "patch", "vgg19", "own")}
    assert network == {"dense": False, "patch": False, "vgg19": True, "own": True}


def test_on_the_cpu_there_is_no_stream_to_enter() -> None:
    with devices.as_here(torch.device("cpu"))():
        pass


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
