"""Trust-region Bayesian optimization: the region, its candidates, the processes, the searches."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from fide_lab.baselines.base import quietly
from fide_lab.baselines.trust_region import (
    FIRST,
    SMALLEST,
    CompositeBO,
    ImageModel,
    LossModel,
    Region,
    TuRBO,
    candidates,
    principal_components,
)
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32, Float64

DIM = 4
DOUBLE = torch.float64


@pytest.fixture
def botorch() -> Iterator[Any]:
    """The library, and one thread, as the optimizers compute with it."""
    with quietly():
        library = pytest.importorskip("botorch")
    with one_thread:
        yield library


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def picture(X: Float64) -> Float32:
    """Images (n, 16, 16, 3) that change smoothly, and not linearly, with the parameters."""
    waves = np.random.default_rng(3).random((DIM, 16 * 16 * 3))
    images: Float32 = (0.5 + 0.4 * np.sin(X @ waves)).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


TARGET = picture(np.array([[0.3, 0.6, 0.4, 0.7]]))[0]


def test_the_region_grows_with_progress_and_shrinks_without() -> None:
    region = Region()
    for _ in range(3):
        region.judge(1.0, 0.5, dim=8, popsize=4)
    assert region.length == 2 * FIRST
    for _ in range(4):  # two rounds of four points are as many as there are parameters
        region.judge(1.0, 0.9995, dim=8, popsize=4)  # less than a thousandth is no progress
    assert region.length == FIRST / 2
    for _ in range(4):
        region.judge(1.0, np.inf, dim=8, popsize=4)
    assert region.length == FIRST / 8


def test_candidates_lie_in_the_box_and_change_some_parameters() -> None:
    best = torch.full((40,), 0.4, dtype=DOUBLE)
    lengthscales = torch.linspace(0.5, 2.0, 40, dtype=DOUBLE)
    points = candidates(best, lengthscales, 0.2, 2000, seeded())
    sides = points.amax(dim=0) - points.amin(dim=0)
    torch.testing.assert_close(
        sides.log().mean().exp(), torch.tensor(0.2, dtype=DOUBLE), rtol=0.02, atol=0
    )
    torch.testing.assert_close(sides / sides[0], lengthscales / lengthscales[0], rtol=0.03, atol=0)
    changed = (points != best).sum(dim=1)
    assert changed.min() >= 1 and abs(changed.double().mean() - 20) < 0.5


def test_candidates_stay_in_the_unit_cube_and_differ_from_the_best() -> None:
    best = torch.tensor([0.0, 1.0], dtype=DOUBLE)
    points = candidates(best, torch.ones(2, dtype=DOUBLE), 1.6, 64, seeded())
    assert points.min() >= 0.0 and points.max() <= 1.0
    assert (points != best).any(dim=1).all()


def test_components_keep_the_distance_from_the_target() -> None:
    wrong = torch.randn(12, 30, generator=seeded(), dtype=DOUBLE) + 0.5
    mean, scores = principal_components(wrong, 24)
    known = wrong.square().sum(dim=1)
    left = (wrong.mean(dim=0).square().sum() - mean.square().sum()).expand(12)
    torch.testing.assert_close((mean + scores).square().sum(dim=1) + left, known)
    assert scores.shape == (12, 11)  # twelve points span eleven directions
    assert principal_components(wrong, 3)[1].shape == (12, 3)


def test_the_image_model_is_a_gaussian_process_conditioned_on_its_data(botorch: Any) -> None:
    """Against the textbook's formulas, at the parameters that were fitted."""
    X = torch.rand(15, 2, generator=seeded(), dtype=DOUBLE)
    Y = torch.stack([(3 * X[:, 0]).sin(), X[:, 1] ** 2, X.sum(dim=1)], dim=1)
    model = ImageModel(X, Y, torch.zeros(3, dtype=DOUBLE), 50)
    at = torch.rand(6, 2, generator=seeded(1), dtype=DOUBLE)
    with torch.no_grad():
        noise = model._log_noise.exp() + 1e-8
        K = model._kernel(X).to_dense() + noise * torch.eye(15, dtype=DOUBLE)
        across = model._kernel(at, X).to_dense()
        mean = across @ torch.linalg.solve(K, Y)
        found, _ = model.posterior(at)
    torch.testing.assert_close(found, mean, atol=1e-6, rtol=1e-6)
    wanted = torch.stack([(3 * at[:, 0]).sin(), at[:, 1] ** 2, at.sum(dim=1)], dim=1)
    assert (found - wanted).abs().max() < 0.15


def test_its_fit_is_a_minimum_of_the_likelihood(botorch: Any) -> None:
    X = torch.rand(30, 2, generator=seeded(), dtype=DOUBLE)
    Y = torch.stack([(6 * X[:, 0]).sin(), (5 * X[:, 0]).cos()], dim=1)
    Y = Y - Y.mean(dim=0)
    model = ImageModel(X, Y, torch.zeros(2, dtype=DOUBLE), 200)
    assert 3 * model.lengthscales[0] < model.lengthscales[1]  # the second plays no part
    with torch.no_grad():
        least = float(model._loss(Y))
        for factor in (0.7, 1.4):
            model._kernel.raw_lengthscale[0, 0] *= factor
            assert float(model._loss(Y)) > least
            model._kernel.raw_lengthscale[0, 0] /= factor


@pytest.mark.parametrize("kind", ["loss", "image"])
def test_what_is_chosen_is_near_the_optimum(botorch: Any, kind: str) -> None:
    X = torch.rand(40, 2, generator=seeded(), dtype=DOUBLE)
    wrong = X - 0.3
    if kind == "loss":
        model: Any = LossModel(X, wrong.square().sum(dim=1, keepdim=True), 50)
    else:
        model = ImageModel(X, wrong - wrong.mean(dim=0), wrong.mean(dim=0), 50)
    points = torch.rand(300, 2, generator=seeded(1), dtype=DOUBLE)
    torch.manual_seed(0)
    chosen = model.choose(points, 8, seeded(2))
    assert len({tuple(x.tolist()) for x in chosen}) == 8
    distance, all_of_them = (chosen - 0.3).norm(dim=1), (points - 0.3).norm(dim=1)
    assert distance.max() < all_of_them.median()
    assert distance.min() < all_of_them.quantile(0.05)


def test_a_smooth_image_is_fitted_in_few_renders(botorch: Any) -> None:
    opt = CompositeBO(DIM, TARGET, popsize=8, initial=8, candidates=200, seed=0)
    while opt.evaluations < 64:
        X = opt.ask()
        opt.tell(X, picture(X))
    assert opt.best is not None and opt.best.loss < 2e-4  # the best of 64 random points: 3e-3


def test_the_loss_plays_no_part_in_the_search_of_the_image(botorch: Any) -> None:
    small: dict[str, Any] = {"popsize": 5, "initial": 5, "candidates": 50, "steps": 2, "seed": 0}
    one, other = CompositeBO(DIM, TARGET, **small), CompositeBO(DIM, TARGET, **small)
    for i in range(3):
        X, Y = one.ask(), other.ask()
        np.testing.assert_array_equal(X, Y)
        one.tell(X, picture(X))
        other.tell(Y, picture(Y), np.arange(5.0) + (i != 1))
    assert other.best is not None and other.best.evaluation == 5


def test_images_that_are_all_equal_teach_nothing_and_do_no_harm(botorch: Any) -> None:
    """The object is out of view."""
    opt = CompositeBO(DIM, TARGET, popsize=4, initial=4, candidates=50, steps=5, seed=0)
    for _ in range(4):
        X = opt.ask()
        assert ((X >= 0) & (X <= 1)).all()
        opt.tell(X, np.zeros_like(picture(X)))
    assert len(np.unique(X, axis=0)) == 4


@pytest.mark.parametrize(("smallest", "halvings"), [(SMALLEST, 7), (0.3, 2), (1e-3, 10)])
def test_a_small_region_is_followed_by_a_new_start(
    botorch: Any, smallest: float, halvings: int
) -> None:
    opt = TuRBO(2, popsize=4, initial=4, candidates=16, steps=1, smallest=smallest, seed=0)
    while opt.starts == 1:
        X = opt.ask()
        opt.tell(X, losses=np.ones(4))  # no progress at all: each round halves the side
    assert opt.evaluations == 4 + 4 * halvings
    design = opt.ask()
    assert design.std() > 0.2 and len(opt._values) == 0


def test_the_center_comes_first(botorch: Any) -> None:
    np.testing.assert_array_equal(TuRBO(3, seed=0).ask()[0], 0.5)


@pytest.mark.parametrize(("kind", "name"), [(TuRBO, "turbo"), (CompositeBO, "composite-bo")])
def test_without_botorch_it_is_named(kind: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "botorch", None)
    with pytest.raises(DependencyError, match=rf"{name} .*pip install botorch .*extra botorch"):
        kind(DIM, TARGET)


@pytest.mark.parametrize(
    "options",
    [
        {"initial": 1},
        {"candidates": 0},
        {"steps": 0},
        {"popsize": 0},
        {"smallest": 0.0},
        {"smallest": 0.8},
    ],
    ids=str,
)
def test_options_out_of_range_are_named(botorch: Any, options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        TuRBO(DIM, **options)
