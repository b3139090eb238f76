"""Probabilities of several answers: shares of hypotheses, and what the renders say."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.fide import FIDE
from fide_plugins.search.hypotheses import _nearest_shares, probabilities
from fide_plugins.search.mixed import Axes
from fide_plugins.search.policy import MovePolicy
from fide_plugins.search.scene import Exchangeability
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64, Posterior

from ..conftest import sample

A, B = np.array([0.25, 0.4, 0.75, 0.6]), np.array([0.75, 0.6, 0.25, 0.4])
SIDE = 12
_GRID = (np.arange(SIDE) + 0.5) / SIDE


def two_cells(x: Float64) -> Float64:
    """Distance (SIDE, SIDE) from the nearest of two centers: no order of them shows."""
    cells = [np.hypot(_GRID[None] - x[i], _GRID[:, None] - x[i + 1]) for i in (0, 2)]
    return np.asarray(np.minimum(*cells) / np.sqrt(2), np.float64)


def around(x: Float64, n: int, seed: int) -> Float64:
    return np.clip(x + 0.03 * np.random.default_rng(seed).standard_normal((n, len(x))), 0, 1)


def posterior(first: int, second: int) -> Float64:
    """So many hypotheses around the two answers, in a random order."""
    both = np.concatenate([around(A, first, 0), around(B, second, 1)])
    return np.random.default_rng(2).permutation(both)


def of(losses: list[float], X: Float64, hypotheses: Float64, typical: float | None) -> Float64:
    dim = X.shape[1]
    tools = Exchangeability(Axes(dim), None, []), Axes(dim)
    return probabilities(losses, X, hypotheses, typical, None, *tools)


def test_the_share_of_hypotheses_is_the_probability() -> None:
    X = np.stack([A, B])
    np.testing.assert_allclose(of([0.0, 0.0], X, posterior(300, 100), 0.1), [0.75, 0.25])


def test_an_answer_that_the_renders_exclude_takes_nothing() -> None:
    near_a = A + 0.06  # a search that was given up
    X = np.stack([A, B, near_a])
    p = of([0.0, 0.0, 0.02], X, posterior(200, 200), 0.1)
    np.testing.assert_allclose(p, [0.5, 0.5, 0.0], atol=1e-6)


def test_a_little_worse_counts_less() -> None:
    """exp(-L / T) with T = 0.01 * 0.1."""
    p = of([0.0, 0.001], np.stack([A, B]), posterior(200, 200), 0.1)
    assert p[0] / p[1] == pytest.approx(float(np.exp(1.0)))


def test_losses_may_be_shifted_scaled_and_noisy() -> None:
    losses, X = np.array([0.3, 0.3004, 0.9]), np.stack([A, A, A])
    hypotheses = posterior(300, 100)
    one = of(losses.tolist(), X, hypotheses, 0.5)
    np.testing.assert_allclose(of((7 * losses - 9).tolist(), X, hypotheses, -5.5), one)
    np.testing.assert_array_equal(of(losses.tolist(), X, hypotheses, None), [1, 0, 0])


def test_what_the_picture_does_not_show_decides_nothing() -> None:
    rng = np.random.default_rng(0)
    hypotheses = rng.random((300, 2))
    hypotheses[:, 0] = 0.3 + 0.4 * (np.arange(300) < 100) + 0.02 * rng.standard_normal(300)
    X = np.array([[0.3, 0.05], [0.7, 0.95]])
    shares = _nearest_shares(X, hypotheses, Exchangeability(Axes(2), None, []), Axes(2))
    np.testing.assert_allclose(shares, [2 / 3, 1 / 3], atol=0.02)


def test_orders_of_blocks_are_one_answer() -> None:
    """Hypotheses of either order belong to the answer, whichever order it was found in."""
    blocks = [[0, 1], [2, 3]]
    other = np.array([0.1, 0.1, 0.9, 0.9])
    hypotheses = np.concatenate([posterior(90, 90), around(other, 60, 4)])
    tools = Exchangeability(Axes(4), None, blocks), Axes(4)
    shares = _nearest_shares(np.stack([B, other]), hypotheses, *tools)
    np.testing.assert_allclose(shares, [0.75, 0.25])


def test_a_circle_has_no_ends() -> None:
    layout = Space(turn=Float(0, 1, periodic=True)).layout
    hypotheses = np.array([[0.98], [0.02], [0.97], [0.5]])
    shares = _nearest_shares(
        np.array([[0.01], [0.6]]), hypotheses, Exchangeability(Axes(1), None, []), Axes(1, layout)
    )
    np.testing.assert_allclose(shares, [0.75, 0.25])


def searched(opt: FIDE, renders: int) -> FIDE:
    while opt.evaluations < renders:
        X = opt.ask()
        opt.tell(X, [two_cells(x) for x in X])
    return opt


def test_both_answers_of_two_cells_are_as_probable(monkeypatch: pytest.MonkeyPatch) -> None:
    there = Posterior(posterior(256, 256))
    monkeypatch.setattr(FIDE, "_model_of", lambda *_: (None, there))
    opt = searched(FIDE(4, two_cells(A), seed=0, groups=[], learned="a model"), 1200)
    found = opt.solutions()
    likely = [one for one in found if one.probability is not None and one.probability > 0.1]
    assert {bool(one.x[0] < 0.5) for one in likely} == {True, False} and len(likely) == 2
    assert [one.probability for one in likely] == pytest.approx([0.5, 0.5], abs=0.1)
    assert sum(one.probability or 0.0 for one in found) == pytest.approx(1.0)

    other = FIDE(4, two_cells(A), seed=0, groups=[])
    other.load_state_dict(opt.state_dict())  # which has all that is needed
    assert [one.probability for one in other.solutions()] == [one.probability for one in found]

    monkeypatch.undo()  # there is no model of the next picture
    opt.retarget(two_cells(B + 0.05))
    assert opt.state.moves.hypotheses is not None and not opt.state.moves.hypotheses.available
    assert all(one.probability is None for one in searched(opt, 1400).solutions())


def test_probabilities_are_shares_of_draws_not_of_refined_points() -> None:
    """Both answers are exact but for rounding, of which one has ten times as much."""
    there = Posterior(posterior(384, 128), np.tile(A, (8, 1)))
    policy = MovePolicy(
        np.full(4, 0.5), np.full(4, 1 / 6), 9, torch.zeros(1, 3), 3, 0, [], posterior=there
    )
    X, target = policy.draw(np.random.default_rng(0)), two_cells(A)
    losses = [float(np.square(two_cells(x) - target).mean()) for x in X]
    samples = [
        sample(two_cells(x).ravel(), x, loss, i)
        for i, (x, loss) in enumerate(zip(X, losses, strict=True))
    ]
    policy.learn(samples, A)
    assert policy.hypotheses is not None
    found = policy.hypotheses
    probable = of([1e-9, 1e-8], np.stack([A, B]), found.x, found.typical)
    assert probable == pytest.approx([0.75, 0.25], abs=0.01)
