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


def test_the_population_of_the_preset_or_as_given(target: Float32) -> None:
    assert FIDE(1, target).popsize == 4
    assert FIDE(40, target).popsize == 4 + int(3 * np.log(40))
    assert FIDE(3, target, popsize=23).popsize == 23
    assert FIDE(3, target, preset="paper").popsize == 500
    assert FIDE(3, target, popsize=23).ask().shape == (23, 3)


def test_the_first_generation_has_the_stated_spread(target: Float32) -> None:
    X = FIDE(2, target, popsize=5000, sigma0=0.05, seed=0).ask()
    np.testing.assert_allclose(X.mean(axis=0), 0.5, atol=0.004)
    np.testing.assert_allclose(X.std(axis=0), 0.05, rtol=0.05)


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


@pytest.mark.parametrize("memory", [1, 2])
def test_a_short_memory_proposes_too(memory: int, render: Render, target: Float32) -> None:
    opt = FIDE(6, target, popsize=8, seed=0, buffer_generations=memory, proposal_fraction=0.5)
    proposed = 0
    for _ in range(5):
        X = opt.ask()
        proposed += sum(c.proposed for c in pending_now(opt))
        opt.tell(X, render(X))
    assert proposed > 5


def test_recommend_is_the_center_first_and_the_mean_later(target: Float32) -> None:
    opt = FIDE(5, target, seed=0)
    np.testing.assert_array_equal(opt.recommend(), np.full(5, 0.5))
    for _ in range(100):
        X = opt.ask()
        opt.tell(X, None, sphere(X))
    assert opt.recommend().shape == (5,)
    np.testing.assert_allclose(opt.recommend(), 0.3, atol=0.01)


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


def test_times_are_spent_where_the_work_is(render: Render, target: Float32) -> None:
    opt = FIDE(6, target, seed=0, **TINY_PAPER)
    assert opt.times == {"encode": 0.0, "train": 0.0, "search": 0.0}
    run(opt, render, 4)
    assert all(seconds > 0 for seconds in opt.times.values())
    assert opt.times["train"] > opt.times["search"]  # a network against six samples


def test_an_empty_tell_changes_nothing(target: Float32, state_of: StateOf) -> None:
    opt = FIDE(6, target, seed=0)
    opt.ask(2)
    before = state_of(opt)
    opt.tell(np.empty((0, 6)), np.empty((0, *target.shape)))
    opt.tell(np.empty((0, 6)), [], [])
    opt.tell(np.empty((0, 6)), None, [])
    assert state_of(opt) == before


@pytest.mark.parametrize("settings", [{}, TINY_PAPER, {"proposer": "none"}])
def test_one_parameter(settings: dict[str, Any], target: Float32, render: Render) -> None:
    opt = FIDE(1, render(np.array([[0.8]]))[0], seed=0, **settings)
    run(opt, render, 25)
    assert opt.best is not None
    assert opt.best.x == pytest.approx(0.8, abs=0.02)


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


def test_what_is_recommended_follows_the_search_that_found_the_best_at_once(
    render: Render, target: Float32
) -> None:
    opt = FIDE(6, target, seed=0, popsize=8, restarts="anew", patience=3)
    while opt.state.searches == 1:
        X = opt.ask()
        opt.tell(X, render(X), np.ones(8))
    X = opt.ask()
    opt.tell(X[:1], render(X[:1]), [0.5])
    np.testing.assert_array_equal(opt.recommend(), opt.state.moves.start.mean)  # where it began


@pytest.mark.parametrize(("popsize", "asked"), [(25_000, None), (10, 25_000)])
def test_a_generation_of_any_size_is_completed(popsize: int, asked: int | None) -> None:
    """Also of more candidates than are remembered where nobody tells them."""
    opt = FIDE(2, TINY, seed=0, popsize=popsize, proposer="none", restarts="none")
    X = opt.ask(asked)
    assert len(X) == 25_000 == opt.state.population.pending
    mean = opt.state.search.mean
    opt.tell(X[::-1], None, sphere(X[::-1]))
    assert opt.state.population.pending == 0 and opt.state.injected is None
    assert opt.state.population.generations == 25_000 // popsize
    assert opt.best is not None and opt.best.loss == sphere(X).min()
    assert (opt.state.search.mean != mean).all()
