"""A small smooth renderer, and the whole state of an optimizer as bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.images import Float32
from fide_plugins.points import Float64

SIZE = 16


def soft_disk(X: Float64) -> Float32:
    """Disks (n, SIZE, SIZE, 3) at x, y = X[:, 0:2], of radius and color by the other columns.

    Columns beyond the sixth have no effect; missing ones are 0.5.
    """
    p = np.full((len(X), 6), 0.5)
    p[:, : X.shape[1]] = X[:, :6]
    grid = (np.arange(SIZE) + 0.5) / SIZE
    x, y, radius = (p[:, i, None, None] for i in range(3))
    distance = np.hypot(grid[None, None, :] - x, grid[None, :, None] - y)
    inside = 1 / (1 + np.exp((distance - 0.1 - 0.3 * radius) * 15))
    images: Float32 = (inside[..., None] * p[:, None, None, 3:]).astype(np.float32)
    return images


@pytest.fixture
def render() -> Callable[[Float64], Float32]:
    return soft_disk


@pytest.fixture
def answer() -> Float64:
    return np.array([0.7, 0.35, 0.6, 0.9, 0.4, 0.2])


@pytest.fixture
def target(answer: Float64) -> Float32:
    image: Float32 = soft_disk(answer[None])[0]
    return image


@pytest.fixture
def state_of(tmp_path: Path) -> Callable[[FIDE], bytes]:
    """All that a checkpoint holds, but for the times."""

    def state_of(opt: FIDE) -> bytes:
        opt._ledger.make_proposals()  # which takes time
        times, path = opt.times, tmp_path / "state"
        opt.times = dict.fromkeys(times, 0.0)
        opt.save(path)
        opt.times = times
        return path.read_bytes()

    return state_of
