"""Acceptance points 17 and 18: ways of telling images, and that memory is bounded."""

from __future__ import annotations

import tracemalloc
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from fide_adapters.nevergrad import ImageLoss
from fide_plugins.errors import ImageError, LossError

from .conftest import TARGET, fide, mse, render


def test_point_17_ways_of_telling() -> None:
    """Optimizers that are told the same in different ways ask the same."""
    tells: list[Callable[[Any, Any, Any], None]] = [
        lambda o, c, image: o.tell(c, image),
        lambda o, c, image: o.tell(c, mse(image), image=image),
        lambda o, c, image: o.tell(c, ImageLoss(mse(image), image)),
        lambda o, c, image: o.tell(c, (mse(image), image)),
    ]
    optimizers = [fide(popsize=4) for _ in tells]
    for _ in range(16):
        candidates = [optimizer.ask() for optimizer in optimizers]
        image = render(candidates[0].value)
        for tell, optimizer, candidate in zip(tells, optimizers, candidates, strict=True):
            np.testing.assert_array_equal(candidate.value, candidates[0].value)
            tell(optimizer, candidate, image)
            assert candidate.loss == pytest.approx(candidates[0].loss, rel=1e-6)
    assert all(optimizer.num_images == 16 for optimizer in optimizers)


FLAT: dict[str, Callable[[Any], Any]] = {
    "array": np.ravel,
    "row": lambda image: image[0, :, 0],
    "list": lambda image: image.ravel().tolist(),
    "torch": lambda image: torch.from_numpy(image.ravel()),
    "with a loss": lambda image: (mse(image), image.ravel()),
}


@pytest.mark.parametrize("kind", FLAT)
def test_a_flat_image_is_not_so_many_objectives(kind: str) -> None:
    """Nevergrad would take its pixels for losses, and have no best candidate."""
    optimizer = fide()
    candidate = optimizer.ask()
    with pytest.raises(ImageError, match=r"\(H, W\) or .* all its axes"):
        optimizer.tell(candidate, FLAT[kind](render(candidate.value)))
    assert optimizer.num_tell == 0 and candidate.loss is None


@pytest.mark.filterwarnings("ignore::nevergrad.common.errors.BadLossWarning")  # of a worse one
@pytest.mark.parametrize("objectives", [2, 15])
def test_several_objectives_are_not_an_image(objectives: int) -> None:
    optimizer = fide()
    for _ in range(2):
        candidate = optimizer.ask()
        image = render(candidate.value)
        losses = [mse(image) + i for i in range(objectives)]
        optimizer.tell(candidate, (losses, image))
        optimizer.tell(optimizer.ask(), np.array(losses), image=image)
    assert optimizer.num_objectives == objectives and optimizer.num_images == 4


def test_point_17_contradictions() -> None:
    optimizer, without = fide(), fide(target=None)
    candidate = optimizer.ask()
    with pytest.raises(ImageError, match="once"):
        optimizer.tell(candidate, ImageLoss(1.0, TARGET), image=TARGET)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        candidate = without.ask()
    for one, result in ((without, TARGET), (optimizer, None)):
        with pytest.raises(LossError, match=r"optimizer\.target"):
            one.tell(candidate, result)
    assert optimizer.num_tell == without.num_tell == 0


@pytest.mark.parametrize("n", [80, pytest.param(5000, marks=pytest.mark.slow)])
def test_point_18_memory_is_bounded(n: int) -> None:
    """The second half needs no more than the first did; its images alone would be 200 kB each."""
    target = np.zeros((128, 128, 3), np.float32)
    options = {"restarts": "none", "buffer_generations": 1, "channel_subsets": (3,)}
    optimizer = fide(target=target, popsize=40, options=options)

    def tell(n: int) -> None:
        for i in range(n):
            image = np.full(target.shape, 0.1 + i % 7 / 10, np.float32)
            optimizer.tell(optimizer.ask(), 1.0 + i % 7, image=image)

    tell(60)
    tracemalloc.start()
    try:
        tell(n)
        kept, peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        tell(n)
        kept_then, peak_then = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_then - kept < 8e6  # Nevergrad keeps 100 to 1,000 candidates
    assert peak_then - peak < 8e6
