"""How much of a distance is Monte Carlo noise, on the beads as a search meets them at its start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_plugins import encoders, losses
from fide_plugins.types import Float32

pytestmark = pytest.mark.slow

N = 16  # candidates


@pytest.fixture(scope="module")
def renders() -> tuple[Float32, Float32]:
    """Two renders of each of N candidates, 16 samples per pixel, of different noise."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (extra mitsuba)")
    task = fide_tasks.make("beads", 112, 0, spp=16)
    X = np.random.default_rng(0).normal(0.5, 1 / 6, (N, task.dim)).clip(0, 1)
    one, two = (task.render(X, seed=[k * N + i for i in range(N)]) for k in (1, 2))
    return one, two


def by_loss(name: str) -> Callable[[Float32, Float32], NDArray[np.float64]]:
    return lambda a, b: np.array([losses.make(name, target)(b) for target in a])


def by_dense(a: Float32, b: Float32) -> NDArray[np.float64]:
    """Distances, not squared, of all features."""
    e, f = (encoders.make("dense")(images).flatten(1).double().numpy() for images in (a, b))
    distances: NDArray[np.float64] = np.linalg.norm(e[:, None] - f, axis=2)
    return distances


@pytest.mark.parametrize(
    ("distance", "most"),
    [(by_loss("perceptual"), 0.1), (by_dense, 0.1)],
    ids=["perceptual", "dense"],
)
def test_noise_is_a_tenth_of_a_difference(
    distance: Callable[[Float32, Float32], NDArray[np.float64]],
    most: float,
    renders: tuple[Float32, Float32],
) -> None:
    distances = distance(*renders)  # (N, N), of a render of i from another of j
    different = distances[~np.eye(N, dtype=bool)]
    assert np.median(np.diag(distances)) < most * np.median(different)
    noise_of_mse = by_loss("mse")(*renders)
    assert np.median(np.diag(noise_of_mse)) > 0.3 * np.median(noise_of_mse)  # it is there
