"""Losses that say little or nothing, and losses of the user's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

from .helpers import TINY_PAPER, Render, run, sphere


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


@pytest.mark.parametrize("error", [MemoryError("too large"), KeyboardInterrupt()])
def test_a_generation_whose_training_raises_is_not_lost(
    error: BaseException, target: Float32, render: Render
) -> None:
    """The search learns from it, and everything told with it is noted, before that is raised."""
    opt, other = (FIDE(6, target, seed=1, **TINY_PAPER) for _ in range(2))
    rest = np.random.default_rng(0).random((3, 6))  # which were never asked

    def fail(*arguments: object) -> None:
        raise error

    X = opt.ask()
    every = np.concatenate([other.ask(), rest])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(opt.state.proposer, "update", fail)
        with pytest.raises(type(error)):
            opt.tell(every, render(every))
    other.tell(every, render(every))
    assert opt.evaluations == other.evaluations == len(every)
    assert opt.state.population.generations == 1
    np.testing.assert_array_equal(opt.state.search.mean, other.state.search.mean)
    X = opt.ask()  # and it goes on
    opt.tell(X, render(X))
