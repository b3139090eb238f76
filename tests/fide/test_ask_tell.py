"""What asking and telling mean, for users who do it as they please."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

from .helpers import TINY, TINY_PAPER, Render, StateOf, pending_now, run, sphere


@pytest.mark.parametrize("dim", [1, 2, 6, 100])
def test_candidates_lie_in_the_box_and_the_best_is_kept(
    dim: int, render: Render, target: Float32
) -> None:
    opt = FIDE(dim, target, seed=0)
    X = run(opt, render, 12)
    assert X.dtype == np.float64 and X.shape[1] == dim and len(X) >= 12 * opt.popsize
    assert X.min() >= 0.0 and X.max() <= 1.0
    losses = np.square(render(X).astype(np.float64) - target).mean(axis=(1, 2, 3))
    best = opt.best
    assert best is not None
    assert best.evaluation == losses.argmin()
    assert best.loss == pytest.approx(losses.min(), rel=1e-12)
    np.testing.assert_array_equal(best.x, X[losses.argmin()])
    np.testing.assert_array_equal(best.image, render(best.x[None])[0])
    assert opt.evaluations == len(X) and opt.not_finite == 0


def test_asking_gives_what_is_left_of_the_generation(target: Float32) -> None:
    opt, other = FIDE(3, target, popsize=8, seed=0), FIDE(3, target, popsize=8, seed=0)
    pieces = [opt.ask(3), opt.ask(1), opt.ask()]
    assert [len(piece) for piece in pieces] == [3, 1, 4]
    np.testing.assert_array_equal(np.concatenate(pieces), other.ask())
    assert len(opt.ask()) == 8  # all are out, so another generation of the same distribution
    assert len(opt.ask(21)) == 21


@pytest.mark.parametrize("proposer", ["linear", "none", "diffusion"])
def test_pieces_and_order_do_not_matter(proposer: str, render: Render, target: Float32) -> None:
    """Bit for bit, also where losses tie and some are not finite."""
    settings: dict[str, Any] = {
        "popsize": 8,
        "seed": 3,
        "proposer": proposer,
        "patience": 5,
        "guard_images": False,
    }
    if proposer == "diffusion":
        settings["epochs"] = 1
    whole, pieces = FIDE(6, target, **settings), FIDE(6, target, **settings)
    rng = np.random.default_rng(0)
    generations = 6 if proposer == "diffusion" else 25
    for _ in range(generations):
        X = whole.ask()
        losses = np.round(sphere(X), 2)
        losses[rng.random(len(X)) < 0.1] = np.nan
        whole.tell(X, render(X), losses)
        Y = np.concatenate([pieces.ask(1), pieces.ask(2), pieces.ask()])
        np.testing.assert_array_equal(X, Y)
        for part in np.array_split(rng.permutation(len(X)), int(rng.integers(1, 5))):
            pieces.tell(Y[part], render(Y[part]), losses[part])
    if proposer != "diffusion":
        assert whole.state.searches > 1
    np.testing.assert_array_equal(whole.ask(), pieces.ask())
    assert whole.best is not None and pieces.best is not None
    np.testing.assert_array_equal(whole.best.x, pieces.best.x)
    np.testing.assert_array_equal(whole.recommend(), pieces.recommend())


def test_same_seed_same_run_and_another_seed_another(render: Render, target: Float32) -> None:
    first, again, other = (run(FIDE(6, target, seed=s), render, 10) for s in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert not (first[0] == other[0]).any()
    drawn = [FIDE(6, target).ask() for _ in range(2)]
    assert not (drawn[0] == drawn[1]).any()


@pytest.mark.parametrize("settings", [{}, TINY_PAPER])
def test_global_random_state_is_neither_read_nor_changed(
    settings: dict[str, Any], render: Render, target: Float32
) -> None:
    runs = []
    for seed in (0, 1):
        random.seed(seed)
        np.random.seed(seed)
        torch.manual_seed(seed)
        before = random.getstate(), repr(np.random.get_state()), torch.get_rng_state()
        runs.append(run(FIDE(6, target, seed=9, **settings), render, 5))
        assert random.getstate() == before[0]
        assert repr(np.random.get_state()) == before[1]
        assert torch.equal(torch.get_rng_state(), before[2])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_recommend_stays_with_the_search_that_found_the_best(target: Float32) -> None:
    opt = FIDE(2, target, seed=0, patience=4, proposer="none", guard_images=False)
    for _ in range(60):
        X = opt.ask()
        opt.tell(X, None, sphere(X))
    searches = opt.state.searches
    assert searches > 1
    kept = opt.recommend()
    for _ in range(12):
        X = opt.ask()
        opt.tell(X, None, sphere(X) + 10)
    np.testing.assert_array_equal(opt.recommend(), kept)


def test_an_empty_tell_changes_nothing(target: Float32, state_of: StateOf) -> None:
    opt = FIDE(6, target, seed=0)
    opt.ask(2)
    before = state_of(opt)
    opt.tell(np.empty((0, 6)), np.empty((0, *target.shape)))
    opt.tell(np.empty((0, 6)), [], [])
    opt.tell(np.empty((0, 6)), None, [])
    assert state_of(opt) == before


def test_the_published_method_runs_as_it_is(render: Render, target: Float32) -> None:
    """Half of each generation is denoised, from the first, and the share stays."""
    opt = FIDE(6, target, seed=0, **TINY_PAPER)
    counts = []
    for _ in range(4):
        X = opt.ask()
        counts.append(sum(c.proposed for c in pending_now(opt)))
        opt.tell(X, render(X))
    assert counts == [3, 3, 3, 3]
    assert opt.state.searches == 1


@pytest.mark.parametrize(("popsize", "asked"), [(25_000, None), (10, 25_000)])
def test_a_generation_of_any_size_is_completed(popsize: int, asked: int | None) -> None:
    """Also of more candidates than are remembered where nobody tells them."""
    opt = FIDE(2, TINY, seed=0, popsize=popsize, proposer="none", restarts="none")
    X = opt.ask(asked)
    assert len(X) == 25_000 == len(opt.state.population.pending)
    mean = opt.state.search.mean
    opt.tell(X[::-1], None, sphere(X[::-1]))
    assert len(opt.state.population.pending) == 0 and opt.state.injected is None
    assert opt.state.population.generations == 25_000 // popsize
    assert opt.best is not None and opt.best.loss == sphere(X).min()
    assert (opt.state.search.mean != mean).all()
