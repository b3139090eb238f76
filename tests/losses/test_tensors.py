"""The path of tensors gives the losses of arrays, to 1e-5."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import losses

SIZES = [(1, 1), (1, 9), (5, 4), (33, 57), (84, 84), (113, 90), (16, 512), (600, 1)]
KINDS: dict[str, Any] = {
    "random": lambda rng, size: rng.random((3, *size, 3)),
    "constant": lambda rng, size: np.broadcast_to(rng.random((3, 1, 1, 3)), (3, *size, 3)),
    "black and white": lambda rng, size: rng.integers(0, 2, (3, *size, 3)),
    "nearly the target": lambda rng, size: 0.5 + 1e-3 * rng.random((3, *size, 3)),
}


@pytest.mark.parametrize("name", ["mse", "perceptual"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_of_tensors_and_of_arrays(name: str, kind: str, size: tuple[int, int]) -> None:
    batch = KINDS[kind](np.random.default_rng(size), size).astype(np.float32)
    loss = losses.make(name, batch[0])
    found = loss.compute_tensor(torch.from_numpy(batch))
    np.testing.assert_allclose(found, loss(batch), atol=1e-5, rtol=0)
    assert found.dtype == np.float64 and found[0] == pytest.approx(0, abs=1e-9)
    assert loss.compute_tensor(torch.from_numpy(batch[:0])).shape == (0,)
    alone = loss.compute_tensor(torch.from_numpy(batch[1:2]))  # its place changes the last digits
    assert alone[0] == pytest.approx(found[1], rel=1e-5, abs=1e-9)


def test_weights_of_pixels() -> None:
    rng = np.random.default_rng(29)
    batch, weights = rng.random((3, 9, 8, 3), dtype=np.float32), rng.random((9, 8))
    loss = losses.make("mse", batch[0], weights=weights)
    found = loss.compute_tensor(torch.from_numpy(batch))
    np.testing.assert_allclose(found, loss(batch), rtol=1e-9)


@pytest.mark.parametrize("name", ["mse", "perceptual"])
def test_a_loss_can_be_pickled_after_it_has_seen_tensors(name: str) -> None:
    batch = np.random.default_rng(29).random((3, 20, 30, 3), dtype=np.float32)
    loss = losses.make(name, batch[0])
    loss.compute_tensor(torch.from_numpy(batch))
    again = pickle.loads(pickle.dumps(loss))
    np.testing.assert_array_equal(again(batch), loss(batch))
    there = torch.from_numpy(batch)
    np.testing.assert_array_equal(again.compute_tensor(there), loss.compute_tensor(there))
