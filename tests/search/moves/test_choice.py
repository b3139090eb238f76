"""A bandit that gives up nothing."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.search.policy import MoveChoice

PRIORS = {"a": 0.5, "b": 0.1, "c": 0.1}


def test_at_first_moves_are_drawn_by_what_is_expected() -> None:
    p = MoveChoice(PRIORS, 100).probabilities(["a", "b", "c"])
    assert p.sum() == pytest.approx(1) and p[1] == p[2]
    assert p[0] == pytest.approx(0.1 + 0.7 * 5 / 7)


@pytest.mark.parametrize("seed", range(5))
def test_what_brings_most_for_its_evaluations_is_drawn_most_and_nothing_starves(seed: int) -> None:
    rng, choice = np.random.default_rng(seed), MoveChoice(PRIORS, 100)
    success = {"a": 0.1, "b": 0.6, "c": 0.6}
    cost = {"a": 100, "b": 100, "c": 300}
    drawn = []
    for _ in range(600):
        name = "abc"[rng.choice(3, p=choice.probabilities(["a", "b", "c"]))]
        choice.note(name, 0.5 * (rng.random() < success[name]), cost[name])
        drawn.append(name)
    shares = {name: drawn[100:].count(name) / 500 for name in PRIORS}
    assert shares["b"] > shares["c"] and shares["b"] > 0.45
    assert min(shares.values()) > 0.06


def test_ten_thousand_vain_tries_leave_a_choice() -> None:
    choice = MoveChoice(PRIORS, 100)
    for name in PRIORS:
        for _ in range(10_000):
            choice.note(name, 0.0, 100)
    choice.load_state_dict(choice.state_dict())
    np.testing.assert_allclose(choice.probabilities(list(PRIORS)), 1 / 3)
    choice.note("b", 0.1, 100)
    assert choice.probabilities(list(PRIORS))[1] > 0.79
