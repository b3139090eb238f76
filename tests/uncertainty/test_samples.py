"""Which samples explain the target as well."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.population import TrainingSample
from fide_plugins.search.mixed import Axes
from fide_plugins.space import Choice, Float, Int, Space
from fide_plugins.types import Float64, Solution
from fide_plugins.uncertainty.estimate import LocalEstimate, independent

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
