"""Losses that say little or nothing, and losses of the user's."""

from __future__ import annotations

from typing import Any

import cmaes
import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.search import mixed
from fide_plugins.types import Float32, Float64

from .helpers import Render, pending_now, run, sphere


def test_of_equals_the_first_asked_is_the_best(target: Float32) -> None:
    opt = FIDE(3, target, seed=0, popsize=4)
    X = opt.ask()
    opt.tell(X[[2, 3]], None, [1.0, 1.0])
    opt.tell(X[[1, 0]], None, [2.0, 1.0])
    opt.tell(opt.ask(), None, np.ones(4))
    assert opt.best is not None
    np.testing.assert_array_equal(opt.best.x, X[0])
    assert opt.best.evaluation == 3


def test_losses_that_are_not_finite_rank_last_and_are_counted(
    render: Render, target: Float32
) -> None:
    """NaN and both infinities are as good as the largest finite loss: only the order counts."""
    settings: dict[str, Any] = {"popsize": 8, "seed": 0, "proposer": "none"}
    bad, huge = FIDE(4, target, **settings), FIDE(4, target, **settings)
    for i, value in enumerate([np.nan, np.inf, -np.inf] * 5):
        X = bad.ask()
        np.testing.assert_array_equal(X, huge.ask())
        losses = sphere(X)
        losses[[1, 4]] = value
        bad.tell(X, render(X), losses)
        losses[[1, 4]] = 1e300
        huge.tell(X, render(X), losses)
        assert bad.not_finite == 2 * (i + 1)
    assert bad.best is not None and huge.best is not None
    assert bad.best.loss == huge.best.loss and np.isfinite(bad.best.loss)
    assert huge.not_finite == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nothing_finite_for_many_generations(value: float, render: Render, target: Float32) -> None:
    opt = FIDE(6, target, seed=0, patience=5)
    for _ in range(30):
        X = opt.ask()
        assert X.min() >= 0 and X.max() <= 1
        opt.tell(X, render(X), np.full(len(X), value))
    assert opt.best is None
    assert opt.not_finite == opt.evaluations == 30 * opt.popsize
    assert np.isfinite(opt.recommend()).all()
    run(opt, render, 40)
    assert opt.best is not None and opt.best.loss < 5e-3


@pytest.mark.parametrize("value", [0.0, 1e300, 5e-324, -7.0])
def test_flat_losses_over_many_restarts(value: float, render: Render, target: Float32) -> None:
    opt = FIDE(6, target, seed=0, patience=3, guard_images=False)
    for g in range(40):
        X = opt.ask()
        opt.tell(X, render(X) if g % 2 else None, np.full(len(X), value))
    assert opt.state.searches > 5
    assert opt.best is not None and opt.best.evaluation == 0


@pytest.mark.parametrize("restarts", ["moves", "none"])
def test_a_search_leaves_a_region_in_which_all_renders_fail(target: Float32, restarts: str) -> None:
    """It begins narrowly in its middle, five standard deviations from where it ends."""
    for seed in range(10):
        opt = FIDE(4, target, seed=seed, sigma0=0.05, restarts=restarts)
        for _ in range(20):
            X = opt.ask()
            inside = np.abs(X - 0.5).max(axis=1) < 0.25
            opt.tell(X, None, np.where(inside, np.inf, sphere(X)))
        assert opt.best is not None


@pytest.mark.filterwarnings("ignore:all images of")
def test_an_image_that_never_changes(target: Float32) -> None:
    opt = FIDE(4, target, seed=0)
    for _ in range(60):
        X = opt.ask()
        assert np.isfinite(X).all() and X.min() >= 0 and X.max() <= 1
        opt.tell(X, np.full((len(X), *target.shape), 0.3), sphere(X))
    assert opt.best is not None and opt.best.loss < 1e-3


def test_a_loss_given_by_the_user_is_called_with_images(render: Render, target: Float32) -> None:
    seen = []

    def darkness(images: Float32) -> Float64:
        seen.append(images.shape)
        values: Float64 = images.mean(axis=(1, 2, 3)).astype(np.float64)
        return values

    opt = FIDE(6, target, loss=darkness, seed=0, popsize=6)
    run(opt, render, 20)
    assert seen[3:] == [(6, *target.shape)] * 20  # after it was tried
    assert opt.best is not None and opt.best.image is not None
    assert opt.best.loss == pytest.approx(float(opt.best.image.mean()))
    assert opt.best.loss < 0.02


def test_without_images_it_is_cma_es(target: Float32, render: Render) -> None:
    """Losses alone: the same candidates as with nothing proposed."""
    told, plain = FIDE(5, target, seed=1), FIDE(5, target, seed=1, proposer="none")
    for _ in range(60):
        X = told.ask()
        np.testing.assert_array_equal(X, plain.ask())
        told.tell(X, None, sphere(X))
        plain.tell(X, render(X), sphere(X))
    assert told.best is not None and told.best.image is None
    assert told.best.loss < 1e-4


@pytest.mark.parametrize(("dim", "popsize"), [(1, 4), (3, 7), (10, 10)])
def test_nothing_proposed_gives_the_numbers_of_a_library(
    dim: int, popsize: int, target: Float32
) -> None:
    """Through ask and tell: reflected candidates outside, what was drawn inside."""
    opt = FIDE(
        dim,
        target,
        popsize=popsize,
        seed=0,
        proposer="none",
        restarts="none",
        guard_search=False,
    )
    reference = cmaes.CMA(np.full(dim, 0.5), 1 / 6, population_size=popsize)
    outside = 0
    for _ in range(30):
        X = opt.ask()
        z = np.array([c.z for c in pending_now(opt)])
        np.testing.assert_array_equal(mixed.into(z), X)
        outside += int((z != X).any(axis=1).sum())
        losses = ((X - 0.05) ** 2).sum(axis=1)
        opt.tell(X, None, losses)
        reference.tell([(z[i].copy(), float(losses[i])) for i in range(popsize)])
        np.testing.assert_allclose(opt.state.search.mean, reference._mean, rtol=1e-8, atol=1e-10)
        assert opt.state.search.distribution.sigma == pytest.approx(reference._sigma, rel=1e-8)
        C = opt.state.search.distribution.C
        np.testing.assert_allclose(C, reference._C, rtol=1e-6, atol=1e-9)
    assert outside > 0
