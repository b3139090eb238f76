"""Candidates that this generation did not ask for: late, injected, or of an earlier search."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render, pending_now, run


@pytest.mark.thorough
def test_many_workers_late_results_and_lost_candidates(render: Render, target: Float32) -> None:
    """Twenty workers, results in any order, one in ten never comes back."""
    opt = FIDE(6, target, popsize=8, seed=0)
    rng = np.random.default_rng(0)
    waiting = list(opt.ask(20))
    told = 0
    for _ in range(1200):
        x = waiting.pop(int(rng.integers(len(waiting))))
        if rng.random() < 0.9:
            opt.tell(x[None], render(x[None]))
            told += 1
        waiting.append(opt.ask(1)[0])
    assert opt.evaluations == told
    assert opt.best is not None and opt.best.loss < 2e-3  # 0.03 at the center
    assert np.isfinite(opt.state.search.mean).all()


def test_points_that_were_never_asked_can_become_the_best(
    render: Render, target: Float32, answer: Float64
) -> None:
    opt = FIDE(6, target, seed=0)
    opt.tell(answer[None], render(answer[None]))
    assert opt.best is not None and opt.best.loss == 0.0
    np.testing.assert_array_equal(opt.best.x, answer)
    assert opt.evaluations == 1
    run(opt, render, 3)
    np.testing.assert_array_equal(opt.best.x, answer)


def test_an_injected_candidate_takes_the_place_of_a_worse_one(
    target: Float32,
) -> None:
    """The documented rule, against a CMA-ES that is told so by hand; others change nothing."""
    settings: dict[str, Any] = {"seed": 0, "popsize": 6, "proposer": "none", "restarts": "none"}
    opt, plain, bad = (FIDE(4, target, **settings) for _ in range(3))
    injected = np.array([[0.0, 0.0, 0.0, 0.0], [0.52, 0.5, 0.5, 0.5]])  # the first is cut
    X = opt.ask()
    losses = np.array([5.0, 3.0, np.inf, 6.0, 2.0, 4.0])
    opt.tell(injected, None, [1.0, 1.5])
    opt.tell(X, None, losses)
    z, ranked = X.copy(), losses.copy()
    z[2], ranked[2] = injected[0], 1.0
    plain.ask()
    plain.state.search.distribution.tell(z, ranked, np.arange(6) == 2)
    np.testing.assert_array_equal(opt.state.search.mean, plain.state.search.mean)
    ours, theirs = opt.state.search.distribution, plain.state.search.distribution
    np.testing.assert_array_equal(ours.C, theirs.C)
    X = opt.ask()
    z = np.array([c.z for c in pending_now(opt)])
    opt.tell(X, None, losses)  # an injected candidate counts once
    plain.state.search.distribution.tell(z, losses, np.zeros(6, bool))
    np.testing.assert_array_equal(opt.state.search.mean, plain.state.search.mean)
    bad.tell(np.full((1, 4), 0.9), None, [7.0])
    losses[2] = 6.5
    bad.tell(bad.ask(), None, losses)
    without = FIDE(4, target, **settings)
    without.tell(without.ask(), None, losses)
    np.testing.assert_array_equal(bad.state.search.mean, without.state.search.mean)
    ours, theirs = bad.state.search.distribution, without.state.search.distribution
    np.testing.assert_array_equal(ours.C, theirs.C)


def test_the_proposer_learns_from_a_warm_start(
    render: Render, target: Float32, answer: Float64
) -> None:
    """What is told before the first generation is known to it after: proposals come at once."""
    opt = FIDE(6, target, popsize=8, seed=0, proposal_fraction=0.5)
    known = answer + 0.05 * np.random.default_rng(0).standard_normal((40, 6))
    known = np.clip(known, 0, 1)
    opt.tell(known, render(known))
    run(opt, render, 1)
    X = opt.ask()
    losses = np.square(render(X).astype(np.float64) - target).mean(axis=(1, 2, 3))
    proposed = np.array([c.proposed for c in pending_now(opt)])
    assert proposed.sum() >= 3
    assert np.median(losses[proposed]) < 0.3 * np.median(losses[~proposed])


def test_a_candidate_of_an_earlier_search_is_injected(render: Render, target: Float32) -> None:
    """It is no member of the new search's generation, and can still become the best."""
    opt = FIDE(6, target, seed=0, popsize=4, patience=3)
    old = opt.ask(1)
    while opt.state.searches == 1:
        X = opt.ask(4)
        opt.tell(X, render(X), np.ones(4))
    mean = opt.state.search.mean.copy()
    X = opt.ask()
    opt.tell(X[:-1], None, 2.0 + np.arange(len(X) - 1))
    opt.tell(old, None, [0.5])
    np.testing.assert_array_equal(opt.state.search.mean, mean)
    opt.tell(X[-1:], None, [1.0])
    assert (opt.state.search.mean != mean).all()
    assert opt.best is not None
    np.testing.assert_array_equal(opt.best.x, old[0])
