"""Samples of a twin, which has the image of the solution far away, have no part in its `std`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, Float, Space
from fide_plugins.population.candidate import TrainingSample
from fide_plugins.search.scene import Axes
from fide_plugins.types import Float32, Float64
from fide_plugins.uncertainty import LocalEstimate
from fide_plugins.uncertainty.samples import of_twins

D, F, NOISE = 4, 60, 0.01
HERE = np.array([0.3, 0.4, 0.5, 0.6])
MIXING = np.random.default_rng(1).normal(size=(3, F))
SCENE = Space(
    x=Float(0, 1), r=Float(0.05, 0.4, log=True), turn=Float(0, 360, unit="deg", periodic=True)
)
V, U = np.mgrid[0:32, 0:32] / 31


def folded(X: Float64) -> Float64:
    """Features (n, F) that are the same at (a, b) and at (0.9 - a, b + 0.3); the last is unseen."""
    beyond = X[:, 0] > 0.45
    a = np.where(beyond, 0.9 - X[:, 0], X[:, 0])
    b = np.where(beyond, X[:, 1] - 0.3, X[:, 1])
    return np.asarray(np.column_stack([a, b, X[:, 2]]) @ MIXING, np.float64)


def around(middle: Float64, n: int, rng: np.random.Generator) -> Float64:
    """Samples of a search that ends there; the last parameter is anything."""
    X = middle + np.geomspace(0.05, 0.003, n)[:, None] * rng.uniform(-1, 1, (n, D))
    X[:, 3] = rng.random(n)
    return X


def std_of(X: Float64, seed: int) -> Float64:
    """Of the first of the samples X (n, D)."""
    rng = np.random.default_rng((seed, 1))
    tokens = folded(X) + NOISE * rng.normal(size=(len(X), F))
    target = torch.as_tensor((folded(X[:1])[0] + NOISE * rng.normal(size=F)).reshape(4, -1))
    kept = torch.as_tensor(tokens.reshape(len(X), 4, -1))
    samples = [
        TrainingSample(i, x, t, 0.0, i) for i, (x, t) in enumerate(zip(X, kept, strict=True))
    ]
    std = LocalEstimate(X[0], samples, target, None, Axes(D)).std
    assert std is not None
    return std


@pytest.mark.parametrize("twins", [1, 20, 300])
@pytest.mark.parametrize("seed", range(3))
def test_samples_of_a_twin_change_little(seed: int, twins: int) -> None:
    """Few or as many as those of the solution; what the image does not show stays open."""
    rng = np.random.default_rng(seed)
    own = np.vstack([HERE, around(HERE, 300, rng)])
    other = around(np.array([0.6, 0.7, 0.5, 0.6]), twins, rng)
    alone, both = std_of(own, seed), std_of(np.vstack([own, other]), seed)
    assert both[:3].max() < 0.02 and both[3] > 0.2
    assert (both < 3 * alone).all() and (alone < 3 * both).all()


def test_samples_along_a_line_of_equal_images_stay() -> None:
    """However far away they are, and on both sides of a gap: the model there says the same."""
    rng = np.random.default_rng(0)
    u = 0.02 * rng.normal(size=(400, 3))
    u[:, 2] = np.where(np.arange(400) < 200, rng.uniform(-0.02, 0.02, 400), 0.6)
    u[0] = 0.0
    e = u[:, :2] @ MIXING[:2] + 0.001 * rng.normal(size=(400, F))
    distances = np.maximum(np.square(e - e[0]).sum(axis=1), 1e-9)
    assert not of_twins(u, e, distances, None).any()


def test_samples_along_a_curve_stay_as_far_as_they_are_joined() -> None:
    """The image shows the distance from a point, so all samples on an arc are alike."""
    rng = np.random.default_rng(0)
    angles = np.append(np.linspace(0, 2, 300), np.full(20, np.pi))
    radius = 0.3 + 0.003 * rng.normal(size=320)
    radius[0] = 0.3
    u = np.column_stack([radius * np.cos(angles), radius * np.sin(angles)]) - [0.3, 0.0]
    e = radius[:, None] * MIXING[0]
    distances = np.maximum(np.square(e - e[0]).sum(axis=1), 1e-9)
    out = of_twins(u, e, distances, None)
    assert not out[:300].any() and out[300:].all()


def test_steps_over_the_seam_of_a_periodic_axis_are_short() -> None:
    """The same arc, of which the coordinates jump by one."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 4.5, 1500)
    radius = 0.4 + 0.003 * rng.normal(size=1500)
    radius[0] = 0.4
    u = np.column_stack([radius * np.cos(angles), radius * np.sin(angles)]) - [0.4, 0.0]
    u = (u + 0.5) % 1 - 0.5
    e = radius[:, None] * MIXING[0]
    distances = np.maximum(np.square(e - e[0]).sum(axis=1), 1e-9)
    assert not of_twins(u, e, distances, np.array([True, True])).any()
    assert of_twins(u, e, distances, None).any()


def disk(p: dict[str, Any]) -> Float32:
    """An image that is the same at (x, turn) and at (x + 0.2 cos(turn), 180 deg - turn)."""
    turn = np.radians(p["turn"])
    far = np.hypot(U - p["x"] - 0.1 * np.cos(turn), V - 0.5 - 0.1 * np.sin(turn))
    image = 1 / (1 + np.exp(30 * (far - p["r"])))
    return np.asarray(np.repeat(image[..., None], 3, axis=2), np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_a_solution_is_known_although_its_twin_was_rendered(seed: int) -> None:
    """As if another search had ended there."""
    opt = FIDE(SCENE, disk({"x": 0.5, "r": 0.2, "turn": 40.0}), seed=seed)
    while opt.evaluations < 600:
        X = opt.ask()
        opt.tell(X, [disk(p) for p in SCENE.decode_many(X)])
    best = opt.best
    assert best is not None and best.params is not None
    turn = best.params["turn"]
    x = best.params["x"] + 0.2 * np.cos(np.radians(turn))
    twin = SCENE.encode({**best.params, "x": x, "turn": (180 - turn) % 360})
    spread = np.geomspace(0.03, 0.0003, 200)[:, None]
    X = np.clip(twin + spread * np.random.default_rng(seed).normal(size=(200, 3)), 0, 1)
    opt.tell(X, [disk(p) for p in SCENE.decode_many(X)])
    assert opt.best is not None and opt.best.std is not None
    assert opt.best.std.max() < 0.03
