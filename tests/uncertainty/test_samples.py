"""Which samples are of another solution, and which explain the target as well."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE
from fide_plugins.population.candidate import TrainingSample
from fide_plugins.search.mixed import Axes
from fide_plugins.space import Choice, Float, Int, Space
from fide_plugins.types import Float32, Float64, Solution
from fide_plugins.uncertainty import LocalEstimate
from fide_plugins.uncertainty.samples import independent, of_twins

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


Y, X = np.mgrid[0:32, 0:32] / 31


def solved(space: Space, images: Float64, points: Float64, target: Float64) -> Solution:
    """The first of the points (n, d), in a run that rendered all of them, images (n, ...)."""
    samples = [
        TrainingSample(i, x, torch.as_tensor(image.reshape(16, -1)), 0.0, i)
        for i, (x, image) in enumerate(zip(points, images, strict=True))
    ]
    axes, discrete = Axes(space.dim, space.layout), space.layout.discrete
    known = torch.as_tensor(target.reshape(16, -1))
    estimate = LocalEstimate(points[0], samples, known, None, axes, discrete)
    return Solution(points[0], 0.0, 0, space=space, estimate=estimate)


def converged(truth: Float64, rng: np.random.Generator, last: float, n: int = 600) -> Float64:
    """Points (n, d) of a search that ends at the truth (d,), its first point."""
    steps = np.geomspace(0.5, last, n)[:, None] * rng.uniform(-1, 1, (n, len(truth)))
    steps[0] = 0.0
    return np.clip(truth + steps, 0.0, 1.0)


HARD = Space(x=Float(0, 1), y=Float(0, 1), gray=Float(0, 1), n=Float(0, 1))


@pytest.mark.parametrize("radius", [0.08, 0.25])
@pytest.mark.parametrize("last", [1e-3, 1e-5])
@pytest.mark.parametrize("seed", range(3))
def test_what_hard_edges_fix_is_not_named(radius: float, last: float, seed: int) -> None:
    """Near the solution the image changes with gray alone; n has no effect."""
    rng = np.random.default_rng(seed)
    points = converged(np.array([0.6, 0.35, 0.7, 0.5]), rng, last)
    points[:, 3] = rng.random(len(points))
    images = np.array([np.where(np.hypot(X - x, Y - y) < radius, g, 0.1) for x, y, g, _ in points])
    best = solved(HARD, images, points, images[0])
    assert best.std is not None
    assert best.undetermined == ("n",) and best.std[:3].max() < 0.05


@pytest.mark.parametrize("colors", [1, 3])
def test_a_gray_picture_has_the_noise_of_one_color(colors: int) -> None:
    """A linear picture: sigma^2 (J J^T)^-1 of the numbers that are independent."""
    rng, sigma = np.random.default_rng(0), 0.02
    waves = np.array([np.cos(np.pi * k * X) * np.cos(np.pi * Y) for k in range(3)]) / 10
    space = Space(a=Float(0, 1), b=Float(0, 1), c=Float(0, 1))
    points = converged(np.array([0.4, 0.5, 0.6]), rng, 1e-4)

    def colored(image: Float64) -> Float64:
        return np.repeat(image[..., None], 3, axis=-1)

    J = waves.reshape(3, -1) if colors == 1 else colored(waves).reshape(3, -1)
    noise = sigma * rng.normal(size=J.shape[1])
    left = noise - np.linalg.lstsq(J.T, noise, rcond=None)[0] @ J  # at the best picture
    clean = colored(np.tensordot(points, waves, 1))
    target = clean[0] + (colored(left.reshape(32, 32)) if colors == 1 else left.reshape(32, 32, 3))
    best = solved(space, clean, points, target)
    exact = np.sqrt(np.square(left).mean() * np.diag(np.linalg.inv(J @ J.T)))
    assert best.std is not None
    np.testing.assert_allclose(best.std, exact, rtol=0.02)


def test_equal_channels_count_once() -> None:
    rng = np.random.default_rng(0)
    gray = np.repeat(rng.random((5, 4)), 3, axis=1)
    colored = rng.random((5, 12))
    partly = np.hstack([gray, rng.random((5, 4))])
    samples = rng.random((6, 60))

    def number(tokens: Float64, features: Float64) -> int:
        return independent(tokens.ravel(), len(tokens), features)

    assert number(gray, samples) == 5 * 4
    assert number(colored, samples) == 5 * 12
    assert number(partly, rng.random((6, 80))) == 5 * 8
    assert number(gray[:, :3], samples[:, :15]) == 5
    assert number(np.full((5, 12), 0.5), samples) == 5 * 4
    samples.reshape(6, 5, 12)[:, 3:] = colored[3:]
    assert number(colored, samples) == 3 * 12, "a mask hides two tokens"
    assert number(colored, colored.reshape(1, 60)) == 12, "at least one"


TIED = Space(k=Int(1, 6), g=Float(0.1, 1), x=Float(0, 1), kind=Choice("p", "q", "r"), m=Int(1, 3))


def test_another_value_that_explains_the_picture_at_other_numbers_is_named() -> None:
    """Only k times g shows, as the width of a spot; `kind` changes nothing and m is seen."""
    rng = np.random.default_rng(0)
    truth = {"k": 3, "g": 0.5, "x": 0.4, "kind": "q", "m": 2}

    def picture(p: dict[str, float]) -> Float64:
        far = np.square(X - p["x"]) + np.square(Y - 0.5)
        spot: Float64 = np.exp(-far / (2 * (0.05 * p["k"] * p["g"]) ** 2))
        return 0.1 * p["m"] + 0.5 * spot

    x = TIED.encode(truth)
    points = np.where(TIED.layout.discrete, x, converged(x, rng, 1e-3))
    others = [{**truth, "k": 2, "g": 0.75}, {**truth, "kind": "r"}, {**truth, "m": 3}]
    points = np.vstack([points, [TIED.encode(p) for p in others]])
    images = np.array([picture(p) for p in TIED.decode_many(points)])
    best = solved(TIED, images, points, images[0])
    assert set(best.undetermined) == {"k", "kind"}
    assert solved(TIED, images[:-3], points[:-3], images[0]).undetermined == ()
