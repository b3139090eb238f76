"""Renders on a GPU: the same rules, features and losses, and no image leaves it.

The GPU is pretended: `Elsewhere` tensors say that they are on another device, and refuse to be
mixed with those of the CPU, as on a real one; what is copied from there is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from fide_plugins import FIDE, encoders, losses
from fide_plugins.errors import ImageError
from fide_plugins.validation.images import as_batch
from fide_plugins.validation.pixels import Clip
from fide_plugins.validation.tensors import as_tensor_batch, stays_on_device

SEED = 41
THERE = torch.device("meta")  # PyTorch starts no driver for it


class Elsewhere(torch.Tensor):
    """A tensor of the CPU that says it is on another device."""

    here: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Elsewhere:
        made: Elsewhere = torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), dtype=inner.dtype, device=THERE
        )
        made.here = inner
        return made

    @classmethod
    def __torch_dispatch__(cls, *args: Any) -> Any:
        raise AssertionError("the device is there within `PretendedDevice` only")


class PretendedDevice(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Computes with `Elsewhere` tensors; `copied`: number of values of each copy to the CPU."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.copied: list[int] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
        there = [each for each in tensors if isinstance(each, Elsewhere)]
        device = kwargs.get("device")
        to = device is not None and torch.device(device) == THERE
        leaves = bool(there) and not to and (device is not None or "_local_scalar" in str(func))
        if leaves:
            self.copied += [each.numel() for each in there]
        elif there and "copy_" not in str(func):
            mixed = [each for each in tensors if each.ndim and not isinstance(each, Elsewhere)]
            assert not mixed, f"{func}: tensors on two devices"
        if to:
            kwargs["device"] = "cpu"
        out = func(*tree_map(_inner, args), **tree_map(_inner, kwargs))
        return tree_map(_outer, out) if (there or to) and not leaves else out


def _inner(value: Any) -> Any:
    return value.here if isinstance(value, Elsewhere) else value


def _outer(value: Any) -> Any:
    return Elsewhere(value) if isinstance(value, torch.Tensor) else value


@pytest.fixture
def device() -> Iterator[PretendedDevice]:
    with PretendedDevice() as device:
        yield device


def picture(height: int = 90, width: int = 101, n: int = 3) -> Any:
    return np.random.default_rng(SEED).random((n, height, width, 3), dtype=np.float32)


def rand(*shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(SEED).random(shape, dtype=np.float32))


# -- rules -----------------------------------------------------------------------------------------

GOOD: dict[str, Callable[[], Any]] = {
    "floats": lambda: rand(3, 9, 8, 3),
    "double precision": lambda: rand(3, 9, 8, 3).double(),
    "half precision": lambda: rand(3, 9, 8, 3).half(),
    "bfloat16": lambda: rand(3, 9, 8, 3).bfloat16(),
    "bytes": lambda: (255 * rand(3, 9, 8, 3)).to(torch.uint8),
    "bool": lambda: rand(3, 9, 8, 3) > 0.5,
    "gray": lambda: rand(3, 9, 8),
    "one channel": lambda: rand(3, 9, 8, 1),
    "alpha": lambda: rand(3, 9, 8, 4),
    "channels first": lambda: rand(3, 4, 9, 8),
    "overshoot": lambda: 1.5 * rand(3, 9, 8, 3) - 0.2,
    "rounding": lambda: torch.full((3, 9, 8, 3), 1 + 5e-7),
    "with gradients": lambda: rand(3, 9, 8, 3).requires_grad_(),
    "none": lambda: rand(0, 9, 8, 3),
}


@pytest.mark.parametrize("kind", GOOD)
def test_a_tensor_is_converted_as_an_array_is(kind: str) -> None:
    images = GOOD[kind]()
    told: list[list[Clip]] = [[], []]
    expected = as_batch(images, (9, 8), on_clip=told[0].append)
    batch = as_tensor_batch(images, (9, 8), on_clip=told[1].append)
    assert batch.dtype == torch.float32 and batch.shape == expected.shape
    assert not batch.requires_grad
    np.testing.assert_allclose(batch.numpy(), expected, atol=1e-7)
    for one, other in zip(*told, strict=True):
        assert replace(one, total=0.0) == replace(other, total=0.0)
        assert one.total == pytest.approx(other.total)


BAD: dict[str, Any] = {
    "NaN": torch.full((2, 9, 8, 3), torch.nan),
    "infinity": torch.full((2, 9, 8, 3), torch.inf),
    "floats in [0, 255]": 255 * rand(2, 9, 8, 3),
    "whole numbers": torch.ones(2, 9, 8, 3, dtype=torch.int64),
    "two channels": rand(2, 9, 8, 2),
    "another size": rand(2, 9, 7, 3),
    "one image": rand(9, 8, 3),
    "three images": rand(3, 9, 8, 3),
    "empty": rand(2, 0, 8, 3),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_is_refused_of_an_array_is_refused_of_a_tensor(kind: str) -> None:
    with pytest.raises(ImageError) as expected:
        as_batch(BAD[kind], (9, 8), n=2)
    with pytest.raises(ImageError) as raised:
        as_tensor_batch(BAD[kind], (9, 8), n=2)
    assert str(raised.value) == str(expected.value)


def test_only_tensors_on_a_gpu_stay() -> None:
    assert stays_on_device(torch.empty(2, device="meta"))
    assert not stays_on_device(torch.empty(2))
    assert not stays_on_device(np.empty(2)) and not stays_on_device("image.png")


# -- no image leaves its device --------------------------------------------------------------------

EXTREMES = 2  # of the values: whether they are in [0, 1]


@pytest.mark.parametrize("name", ["dense", "patch"])
def test_an_encoder_computes_where_the_images_are(name: str, device: PretendedDevice) -> None:
    images = picture()
    encoder = encoders.make(name)
    expected = encoder(images)
    tokens = encoder(torch.from_numpy(images).to(THERE))
    assert tokens.device.type == "cpu"
    torch.testing.assert_close(tokens, expected, atol=1e-5, rtol=0)
    assert device.copied == [EXTREMES, tokens.numel()]


@pytest.mark.parametrize("name", ["mse", "perceptual"])
def test_a_loss_computes_where_the_images_are(name: str, device: PretendedDevice) -> None:
    images = picture()
    loss = losses.make(name, images[0])
    values = loss(torch.from_numpy(images).to(THERE))
    np.testing.assert_allclose(values, loss(images), atol=1e-5, rtol=0)
    assert values.dtype == np.float64 and values[0] == pytest.approx(0, abs=1e-9)
    assert device.copied == [EXTREMES, len(images)]


@pytest.mark.parametrize("loss", ["mse", "perceptual", None])
def test_of_what_is_told_only_the_best_image_leaves(
    loss: str | None, device: PretendedDevice
) -> None:
    images = picture(n=4)
    images[2] = 0.9 * images[0] + 0.1 * images[1]  # the best, after one that was best before it
    target, renders = images[0], torch.from_numpy(images[1:])
    runs = [FIDE(2, target, loss=loss or "mse", seed=3, popsize=4) for _ in range(2)]
    device.copied.clear()
    told = []
    for run, told_images in zip(runs, (renders, renders.to(THERE)), strict=True):
        given = None if loss is not None else [0.3, 0.1, 0.2]
        told.append(run.tell(run.ask(3), told_images, given))
    np.testing.assert_allclose(told[0], told[1], atol=1e-5, rtol=0)
    best = runs[1].best
    assert best is not None and isinstance(best.image, np.ndarray)
    np.testing.assert_array_equal(best.image, images[2])
    each = target.size
    assert sorted(device.copied)[-2:] == [each, each] and sum(device.copied) < 3 * each


def test_what_cannot_be_computed_there_is_computed_here(device: PretendedDevice) -> None:
    """The loss `loi` needs NumPy, so the images come, once."""
    images = picture(20, 20, n=2)
    run = FIDE(2, images[0], loss="loi", seed=3, popsize=4)
    there = torch.from_numpy(images[1:]).to(THERE)
    device.copied.clear()
    batch = run.evaluator.as_batch(1, there, None, None, print)
    np.testing.assert_array_equal(batch, images[1:])
    assert device.copied == [images[1:].size]


# -- a real one ------------------------------------------------------------------------------------


@pytest.mark.gpu
@pytest.mark.parametrize("size", [(112, 112), (90, 101), (7, 5), (2, 40)])
def test_on_cuda(size: tuple[int, int]) -> None:
    images = picture(*size, n=5)
    there = torch.from_numpy(images).cuda()
    encoder = encoders.make("dense")
    torch.testing.assert_close(encoder(there), encoder(images), atol=1e-5, rtol=0)
    torch.testing.assert_close(encoder(there[1:2])[0], encoder(there)[1], atol=1e-6, rtol=0)
    for name in ("mse", "perceptual"):
        loss = losses.make(name, images[0])
        np.testing.assert_allclose(loss(there), loss(images), atol=1e-5, rtol=0)
        assert loss(there)[0] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(loss(there[1:2])[0], loss(there)[1], atol=1e-6)
