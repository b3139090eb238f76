"""Standard deviations from samples of a search: the linear model, and the estimate."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, fit
from fide_plugins.population import TrainingSample
from fide_plugins.search.mixed import Axes
from fide_plugins.space import Choice, Float, Int, Space
from fide_plugins.types import Float32, Float64
from fide_plugins.uncertainty.estimate import LocalEstimate, aligned
from fide_plugins.uncertainty.local_fit import (
    WIDER,
    FitToTarget,
    LocalFit,
    covariance,
    fit_locally,
)

D, F, N = 6, 300, 400
MIXING = np.random.default_rng(1).normal(size=(D, F))
HERE = np.full(D, 0.4)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def fitted(
    rng: np.random.Generator, *, noise: float = 0.0, mixing: Float64 = MIXING, width: float = 0.3
) -> LocalFit:
    """At HERE, from images that are linear in the parameters."""
    u = rng.uniform(-width, width, size=(N, D))
    e = (HERE + u) @ mixing + noise * rng.normal(size=(N, F))
    return fit_locally(u, e, np.square(e - HERE @ mixing).sum(axis=1))


def test_a_linear_renderer_is_found_exactly(rng: np.random.Generator) -> None:
    fit = fitted(rng)
    np.testing.assert_allclose(fit.J, MIXING, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(fit.at_solution, HERE @ MIXING, atol=1e-3)


def test_the_covariance_is_that_of_least_squares(rng: np.random.Generator) -> None:
    """Of a target with noise, at the parameters that fit it best: sigma^2 (J J^T)^-1."""
    fit, sigma = fitted(rng), 0.05
    exact = np.sqrt(np.diag(sigma**2 * np.linalg.inv(MIXING @ MIXING.T)))
    noise = sigma * rng.normal(size=F)
    explained = np.linalg.lstsq(MIXING.T, noise, rcond=None)[0]  # of a search that is not over
    target = HERE @ MIXING + noise - explained @ MIXING
    found = np.sqrt(np.diag(covariance(FitToTarget(fit, target, F))))
    sample = np.sqrt(np.square(noise - explained @ MIXING).mean()) / sigma  # of this noise
    np.testing.assert_allclose(found, sample * exact, rtol=0.03)


def test_a_search_that_has_converged_knows_no_more_than_the_noise_of_the_target_says(
    rng: np.random.Generator,
) -> None:
    """Clean renders: the samples lie together, and the truth is as far away as ever."""
    sigma = 0.05
    exact = np.sqrt(np.diag(sigma**2 * np.linalg.inv(MIXING @ MIXING.T)))
    noise = sigma * rng.normal(size=F)
    left = noise - np.linalg.lstsq(MIXING.T, noise, rcond=None)[0] @ MIXING
    sample = np.sqrt(np.square(left).mean()) / sigma  # of this noise
    for last in (1e-2, 1e-4, 1e-6):
        u = np.geomspace(0.3, last, N)[:, None] * rng.uniform(-1, 1, size=(N, D))
        e = (HERE + u) @ MIXING
        fit = fit_locally(u, e, np.square(e - HERE @ MIXING).sum(axis=1))
        found = np.sqrt(np.diag(covariance(FitToTarget(fit, HERE @ MIXING + left, F))))
        np.testing.assert_allclose(found, sample * exact, rtol=0.03)


def test_noise_of_the_renders_is_not_taken_for_knowledge(rng: np.random.Generator) -> None:
    """A parameter without effect: its column of the Jacobian is noise, and nothing else."""
    blind = MIXING.copy()
    blind[2] = 0.0
    for noise in (0.0, 0.5):
        fit = fitted(rng, noise=noise, mixing=blind)
        target = HERE @ blind + 0.05 * rng.normal(size=F)
        std = np.sqrt(np.diag(covariance(FitToTarget(fit, target, F))))
        reach = WIDER**2 * fit.cloud[2, 2]  # of samples that look alike
        assert std[2] == pytest.approx((12 + 1 / reach) ** -0.5, rel=0.1)
        assert 0.2 < std[2] < 12**-0.5
        assert np.delete(std, 2).max() < 0.03


def test_the_error_of_an_unfinished_search_counts(rng: np.random.Generator) -> None:
    """The farther the target is from what is rendered here, the wider the interval."""
    fit = fitted(rng)
    away = rng.normal(size=D)
    away /= np.linalg.norm(away)
    stds = []
    for length in (0.01, 0.02, 0.04):
        target = (HERE + length * away) @ MIXING
        stds.append(np.sqrt(np.diag(covariance(FitToTarget(fit, target, F)))))
        z = np.abs(length * away / stds[-1])
        assert 0.4 < np.sqrt(np.square(z).mean()) < 2.0
    np.testing.assert_allclose(stds[1], 2 * stds[0], rtol=0.05)
    np.testing.assert_allclose(stds[2], 4 * stds[0], rtol=0.1)


def test_intervals_hold_the_truth_as_often_as_they_say(rng: np.random.Generator) -> None:
    """Of least squares fits to noisy targets with noisy renders: 90 %, give or take chance."""
    inside = []
    for _ in range(60):
        fit = fitted(rng, noise=0.1)
        clean = HERE @ MIXING
        noisy = clean + 0.1 * rng.normal(size=F)
        wrong = np.linalg.lstsq(MIXING.T, noisy - clean, rcond=None)[0]  # the minimum, less HERE
        std = np.sqrt(np.diag(covariance(FitToTarget(fit, noisy - wrong @ MIXING, F))))
        inside.append(np.abs(wrong) <= 1.645 * std)
    assert 0.84 < np.mean(inside) < 0.96  # five standard errors of 360


def test_a_step_along_which_nothing_changes_is_unseen_however_short(
    rng: np.random.Generator,
) -> None:
    """A search that has converged, in all parameters alike; curvature is its only error."""
    blind = MIXING.copy()
    blind[2] = 0.0
    u = np.geomspace(0.3, 1e-6, N)[:, None] * rng.uniform(-1, 1, size=(N, D))
    e = (HERE + u) @ blind + np.square(u) @ np.abs(blind)
    distances = np.square(e - HERE @ blind).sum(axis=1)
    fit = fit_locally(u, e, distances)
    model = FitToTarget(fit, HERE @ blind, F, float(distances.max()))
    std = np.sqrt(np.diag(covariance(model)))
    assert std[2] == pytest.approx(12**-0.5, rel=1e-3)
    assert np.delete(std, 2).max() < 1e-3


DIM, SIDE = 5, 16
RAMPS = np.random.default_rng(2).uniform(-1, 1, (DIM, SIDE, SIDE, 3)) / DIM
RAMPS[3] = 0.0  # of which the picture says nothing
TRUTH = np.array([0.3, 0.6, 0.45, 0.5, 0.7])


def render(X: Float64) -> Float32:
    images: Float32 = (0.5 + np.tensordot(X - 0.5, RAMPS, 1)).astype(np.float32)
    return images


def run(evaluations: int = 400, seed: int = 1, **options: object) -> FIDE:
    opt = FIDE(DIM, render(TRUTH[None])[0], seed=seed, popsize=10, encoder="patch", **options)  # type: ignore[arg-type]
    while opt.evaluations < evaluations:
        X = opt.ask()
        opt.tell(X, render(X))
    return opt


def samples_of(points: Float64, tokens: Float64) -> list[TrainingSample]:
    kept = torch.as_tensor(tokens.reshape(len(points), 4, -1))
    return [
        TrainingSample(i, x, t, 0.0, i) for i, (x, t) in enumerate(zip(points, kept, strict=True))
    ]


def test_what_the_picture_does_not_show_is_open_and_the_rest_is_not() -> None:
    several = [run(seed=seed).best for seed in range(5)]
    stds = np.array([best.std for best in several if best is not None])
    assert np.median(stds[:, 3]) > 0.1 and stds.max() <= 12**-0.5 + 1e-9
    assert np.delete(stds, 3, axis=1).max() < 0.05


def test_saved_and_pickled_it_is_the_same(tmp_path: Path) -> None:
    opt = run(250)
    opt.save(tmp_path / "opt")
    for one, other in zip(opt.solutions(), FIDE.load(tmp_path / "opt").solutions(), strict=True):
        assert one.std is not None and other.std is not None
        np.testing.assert_array_equal(one.std, other.std)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(one)).std, one.std)


def test_few_samples_say_nothing() -> None:
    opt = FIDE(DIM, render(TRUTH[None])[0], seed=1, popsize=10)
    X = opt.ask()
    opt.tell(X, render(X))
    assert opt.best is not None and opt.best.std is None
    assert run(100, memory_mb=0).best.std is None  # type: ignore[union-attr]
    opt = FIDE(DIM, render(TRUTH[None])[0], seed=1)
    opt.tell(X, losses=np.arange(len(X), dtype=float))
    assert opt.best is not None and opt.best.std is None


def test_integers_and_choices_have_none() -> None:
    space = Space(a=Float(0, 1), n=Int(1, 4), kind=Choice("u", "v", "w"), b=Float(0, 2))
    rng = np.random.default_rng(0)
    X = np.array([space.snap(x) for x in rng.random((600, space.dim))])
    mixing = rng.normal(size=(space.dim, 40))
    samples = samples_of(X, X @ mixing)
    discrete = space.layout.discrete
    target = torch.as_tensor((X[7] @ mixing + 0.01 * rng.normal(size=40)).reshape(4, -1))
    one = LocalEstimate(X[7], samples, target, None, Axes(space.dim, space.layout), discrete)
    assert one.std is not None
    np.testing.assert_array_equal(np.isnan(one.std), discrete)
    assert np.isfinite(one.std[~discrete]).all() and one.std[~discrete].max() < 0.05


def test_periodic_parameters_are_near_themselves() -> None:
    """Samples on both sides of the seam are as good as samples in the middle."""
    space = Space(angle=Float(-180, 180, periodic=True), b=Float(0, 1))
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(2, 40))
    steps = rng.uniform(-0.1, 0.1, (80, 2))
    noise = 0.01 * rng.normal(size=40)
    stds: list[Float64] = []
    for middle in (np.array([0.5, 0.5]), np.array([0.01, 0.5])):
        X = (middle + np.vstack([np.zeros(2), steps])) % 1.0
        tokens = np.vstack([np.zeros(2), steps]) @ mixing
        axes = Axes(2, space.layout)
        target = torch.as_tensor(noise.reshape(4, -1))
        std = LocalEstimate(X[0], samples_of(X, tokens), target, None, axes).std
        assert std is not None
        stds.append(std)
    np.testing.assert_allclose(stds[0], stds[1], rtol=1e-6)


def test_blocks_are_matched_or_left_out() -> None:
    blocks = np.array([[0, 1], [2, 3], [4, 5]])
    x = np.array([0.1, 0.1, 0.5, 0.5, 0.9, 0.9])
    points = np.array([x, np.roll(x, 2), x[[2, 3, 0, 1, 4, 5]], np.full(6, 0.5)]) + 0.01
    found, which = aligned(points, x, blocks, Axes(6))
    assert which.tolist() == [True, True, True, False]
    np.testing.assert_allclose(found[:3], np.tile(x + 0.01, (3, 1)))


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_points_may_come_back_in_single_precision(kind: type) -> None:
    """The cell of 2 in 1 to 7 has its middle at 3/14, which single precision does not have."""
    space = Space(a=Float(0, 1), b=Float(0, 1), n=Int(1, 7))
    y, x = np.mgrid[0:16, 0:16] / 15

    def spot(p: dict[str, float]) -> Float64:
        far: Float64 = np.square(x - p["a"]) + np.square(y - p["b"])
        return np.exp(-20 * far) * p["n"] / 7

    opt = FIDE(space, spot({"a": 0.4, "b": 0.6, "n": 2}), seed=0)
    while opt.evaluations < 300:
        X = opt.ask()
        opt.tell(X.astype(kind), [spot(p) for p in space.decode_many(X)])
    assert opt.best is not None and opt.best.std is not None
    assert np.isnan(opt.best.std).tolist() == [False, False, True]


def test_a_parameter_that_never_moved_is_open() -> None:
    X = np.random.default_rng(0).random((200, DIM))
    X[:, 1] = 0.5
    opt = FIDE(DIM, render(TRUTH[None])[0], seed=1, encoder="patch")
    opt.tell(X, render(X))
    assert opt.best is not None and opt.best.std is not None
    assert opt.best.std[1] == pytest.approx(12**-0.5)


SCENE = Space(
    x=Float(-0.7, 0.7), y=Float(-0.7, 0.7), gray=Float(0.1, 1), shape=Choice("disk", "square"),
    paper=Choice("a4", "a5", "a6"), rows=Int(1, 4), pages=Int(1, 4),
)  # fmt: skip


@pytest.mark.thorough
def test_a_search_knows_which_choices_the_picture_does_not_show() -> None:
    """Noise in every render; of six seeds, since how often a search tries a value is chance."""
    v, u = np.mgrid[-1:1:16j, -1:1:16j]
    named: list[str] = []
    for seed in range(6):
        rng = np.random.default_rng(seed)

        def picture(x: Float64, rng: np.random.Generator = rng) -> Float32:
            p = SCENE.decode(x)
            far = (u - p["x"], v - p["y"])
            reach = np.hypot(*far) if p["shape"] == "disk" else np.abs(far).max(axis=0)
            inside = 1 / (1 + np.exp(20 * (reach - 0.5)))
            lines = 0.25 + 0.2 * np.cos(np.pi * p["rows"] * v)
            image = inside * p["gray"] + (1 - inside) * lines + 0.02 * rng.normal(size=v.shape)
            return np.asarray(np.clip(image, 0, 1), np.float32)

        opt = FIDE(SCENE, picture(rng.random(SCENE.dim)), seed=seed)
        while opt.evaluations < 500:
            X = opt.ask()
            opt.tell(X, np.array([picture(x) for x in X])[..., None].repeat(3, axis=3))
        assert opt.best is not None
        named += opt.best.undetermined
    assert named.count("paper") >= 3 and named.count("pages") >= 3
    assert named.count("rows") == 0 and named.count("shape") <= 2


BLIND = Space(a=Float(0, 1), b=Float(0, 1), n=Float(-5, 5))


def spot(p: dict[str, float]) -> Float64:
    """A picture (24, 24) of a spot at (a, b)."""
    y, x = np.mgrid[0:24, 0:24] / 23
    bright: Float64 = np.exp(-(np.square(x - p["a"]) + np.square(y - p["b"])) / 0.045)
    return bright


@pytest.mark.thorough
@pytest.mark.parametrize("budget", [60, 200])
def test_a_search_of_steps_does_not_know_what_the_picture_does_not_show(budget: int) -> None:
    """A step leaves such a parameter where it is, so that its samples soon lie together."""
    target = spot({"a": 0.3, "b": 0.6})
    several = [
        fit(spot, target, BLIND, budget=budget, workers=0, seed=seed).best for seed in range(12)
    ]
    found = [best for best in several if best is not None]
    named = [one.undetermined for one in found]
    assert named.count(("n",)) >= 8 and set(named) <= {("n",), ()}
    assert all(one.std is not None and one.std[:2].max() < 0.05 for one in found)


@pytest.mark.parametrize("seed", [0, 5, 7])
def test_what_has_converged_to_the_last_digits_has_moved(seed: int) -> None:
    """Samples near the solution differ by less than 1e-9 in b."""
    space = Space(a=Float(0, 1), b=Float(0, 1))

    def row(p: dict[str, float]) -> Float64:
        return spot({"a": 0.5, "b": p["b"]})

    best = fit(row, row({"b": 0.3}), space, 300, until="budget", workers=0, seed=seed).best
    assert best is not None and best.std is not None and best.std[1] < 1e-3
    assert best.undetermined == ("a",)


def test_of_images_that_are_all_equal_every_parameter_is_open() -> None:
    """The model is nothing but its error, which is rounding, of many parameters."""
    opt = FIDE(40, np.full((16, 16), 0.5), seed=0)
    with pytest.warns(RuntimeWarning, match="all images of"):
        while opt.evaluations < 240:
            X = opt.ask()
            opt.tell(X, np.full((len(X), 16, 16), 0.5))
    assert opt.best is not None and opt.best.std is not None
    assert opt.best.std.min() > 0.2 and opt.best.std.max() <= 12**-0.5 + 1e-9
