"""LPIPS against its definition, computed step by step, and against the package `lpips`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fide_lab.pretrained import backbones, weights
from fide_lab.pretrained.lpips import LAYERS
from fide_plugins import losses
from fide_plugins.errors import (
    DeviceError,
    ImageError,
    WeightsMismatchError,
    WeightsNotFoundError,
)
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

RNG = np.random.default_rng(12)


def pair(height: int, width: int) -> tuple[Float32, Float32]:
    a, b = RNG.random((2, height, width, 3), dtype=np.float32)
    return a, b


# -- the definition, in double precision -----------------------------------------------------------


def activations(state: dict[str, Tensor], x: Tensor) -> list[Tensor]:
    """All five ReLUs of AlexNet."""

    def conv(x: Tensor, name: str, stride: int = 1, padding: int = 1) -> Tensor:
        weight, bias = (state[f"features.{name}.{k}"].double() for k in ("weight", "bias"))
        return F.relu(F.conv2d(x, weight, bias, stride, padding))

    one = conv(x, "0", 4, 2)
    two = conv(F.max_pool2d(one, 3, 2), "3", 1, 2)
    three = conv(F.max_pool2d(two, 3, 2), "6")
    four = conv(three, "8")
    return [one, two, three, four, conv(four, "10")]


def by_definition(
    state: dict[str, Tensor], heads: dict[str, Tensor], a: Float32, b: Float32
) -> float:
    shift = torch.tensor([-0.030, -0.088, -0.188]).double()[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450]).double()[:, None, None]
    x = torch.from_numpy(np.stack([a, b])).double().permute(0, 3, 1, 2)
    total = 0.0
    for i, y in enumerate(activations(state, (x * 2 - 1 - shift) / scale)):
        unit = y / torch.linalg.vector_norm(y, dim=1, keepdim=True).clamp_min(1e-300)
        w = heads[f"lin{i}.model.1.weight"].double().flatten()
        total += float(torch.einsum("chw,c->hw", (unit[0] - unit[1]) ** 2, w).mean())
    return total


@pytest.mark.parametrize("size", [(40, 53), (64, 64)])
def test_the_definition(size: tuple[int, int], cached_weights: Path) -> None:
    state = weights.read(cached_weights / "alexnet-owt-7be5be79.pth")
    heads = cached_weights / "lpips-v0.1-alex.pth"
    a, b = pair(*size)
    value = losses.make("lpips", a, heads=heads, device="cpu")(b[None])[0]
    expected = by_definition(state, weights.read(heads), a, b)
    assert expected > 0.1
    np.testing.assert_allclose(value, expected, atol=1e-5)


# -- what it takes ---------------------------------------------------------------------------------


def test_a_device_that_is_not_there(cached_weights: Path) -> None:
    with pytest.raises(DeviceError):
        losses.make("lpips", RNG.random((32, 32, 3)), device="abacus")


def test_the_smallest_image(cached_weights: Path) -> None:
    a, b = pair(31, 40)
    assert losses.make("lpips", a)(b[None])[0] > 0
    with pytest.raises(ImageError, match="at least 31 x 31 pixels, got 30 x 80 .*'perceptual'"):
        losses.make("lpips", np.zeros((30, 80, 3)))
    with pytest.raises(RuntimeError, match="too small|size"):  # so the limit is the network's own
        backbones.load(backbones.ALEXNET).taps(torch.zeros(1, 3, 30, 80), LAYERS)


def test_without_weights(no_weights: Path) -> None:
    target = np.zeros((40, 40, 3))
    message = (
        r"AlexNet at .*alexnet-owt-7be5be79\.pth; .*download=True.*url.*'perceptual' needs none"
    )
    with pytest.raises(WeightsNotFoundError, match=message.replace("url", "https://download")):
        losses.make("lpips", target)
    with pytest.raises(WeightsNotFoundError, match="AlexNet"):
        FIDE(3, target, loss="lpips")
    assert not no_weights.exists()


def test_heads_of_the_package_are_found(
    cached_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package of that name, of which nothing is imported."""
    folder = tmp_path / "lpips" / "weights" / "v0.1"
    folder.mkdir(parents=True)
    (tmp_path / "lpips" / "__init__.py").write_text("raise ImportError('torchvision')")
    heads = weights.read(cached_weights / "lpips-v0.1-alex.pth")
    torch.save({key: 2 * value for key, value in heads.items()}, folder / "alex.pth")
    a, b = pair(40, 40)
    single = losses.make("lpips", a, heads=cached_weights / "lpips-v0.1-alex.pth")(b[None])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    np.testing.assert_allclose(losses.make("lpips", a)(b[None]), 2 * single, rtol=1e-6)


def test_heads_below_zero(cached_weights: Path, tmp_path: Path) -> None:
    heads = weights.read(cached_weights / "lpips-v0.1-alex.pth")
    heads["lin2.model.1.weight"][0, 7] = -0.25
    torch.save(heads, tmp_path / "heads.pth")
    message = r"heads\.pth: 'lin2\.model\.1\.weight' has values below 0, the least -0\.25"
    with pytest.raises(WeightsMismatchError, match=message):
        losses.make("lpips", np.zeros((40, 40, 3)), heads=tmp_path / "heads.pth")
