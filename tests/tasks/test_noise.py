"""Noisy renders against a measured mean and variance, pixel by pixel.

tests/data/NAME_noise.npz holds the mean m and the variance v of N single frames, (H, W, 3), made by
tests/data/noise_reference.py. The mean of n new frames is compared to m by

    z = (mean - m) / sqrt(v / n + v / N)

in every pixel and channel at once, k comparisons in all, so that one is wrongly refused with
probability ALPHA together (Šidák's correction). The limit of |z| is not the normal quantile: a
pixel that a rare path makes white is far from normal even after many frames. It comes from
Bernstein's inequality, which holds for any values in [0, 1]:

    P(|mean - m| > s z) <= 2 exp(-L)   for   z = L / (3 n s) + sqrt((L / (3 n s))^2 + 2 L)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import Task

pytestmark = pytest.mark.thorough

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")

NAMES = ["beads", "san_miguel"]
ALPHA = 0.01
FRAMES = 96  # n
Array = NDArray[np.float64]
Measured = dict[str, Any]


@pytest.fixture(params=NAMES, scope="module")
def measured(request: pytest.FixtureRequest) -> Measured:
    path = Path(__file__).parents[1] / "data" / f"{request.param}_noise.npz"
    with np.load(path) as file:
        return {"name": request.param, **{key: file[key] for key in file.files}}


@pytest.fixture(scope="module")
def task(measured: Measured) -> Task:
    return fide_tasks.make(measured["name"], size=int(measured["size"]), spp=int(measured["spp"]))


def refused(mean: Array, measured: Measured) -> NDArray[np.bool_]:
    """Which pixels of the mean of FRAMES frames, (H, W, 3), are not as measured."""
    n = FRAMES
    variance = np.maximum(measured["variance"], 1e-6)
    s = np.sqrt(variance / n + variance / measured["frames"])
    z = np.abs(mean - measured["mean"]) / s
    alpha = 1 - (1 - ALPHA) ** (1 / z.size)
    L = np.log(2 / alpha)
    jump = L / (3 * n * s)
    return np.asarray(z > jump + np.sqrt(jump**2 + 2 * L))


def mean_of_frames(task: Task, x: Array, seed: int) -> Array:
    return np.asarray(
        task.render(np.tile(x, (FRAMES, 1)), seed=seed).mean(axis=0, dtype=np.float64)
    )


@pytest.fixture(scope="module")
def mean(task: Task, measured: Measured) -> Array:
    return mean_of_frames(task, measured["x"], seed=1)


def test_renders_are_as_measured(mean: Array, measured: Measured) -> None:
    assert not refused(mean, measured).any()


def test_a_moved_scene_is_refused(task: Task, measured: Measured) -> None:
    x = measured["x"].copy()
    x[7] += 0.25 if x[7] < 0.5 else -0.25  # a bead, or the light
    assert refused(mean_of_frames(task, x, seed=2), measured).sum() > 5
