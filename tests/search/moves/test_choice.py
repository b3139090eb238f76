"""A bandit that gives up nothing."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.search.policy import Choice

PRIORS = {"a": 0.5, "b": 0.1, "c": 0.1}


def test_at_first_moves_are_drawn_by_what_is_expected() -> None:
    p = Choice(PRIORS, 100).probabilities(["a", "b", "c"])
    assert p.sum() == pytest.approx(1) and p[1] == p[2]
    assert p[0] == pytest.approx(0.1 + 0.7 * 5 / 7)


@pytest.mark.parametrize("seed", range(5))
def test_what_brings_most_for_its_evaluations_is_drawn_most_and_nothing_starves(seed: int) -> None:
    rng, choice = np.random.default_rng(seed), Choice(PRIORS, 100)
    success = {"a": 0.1, "b": 0.6, "c": 0.6}
    cost = {"a": 100, "b": 100, "c": 300}
    drawn = []
    for _ in range(600):
        name = choice.draw(["a", "b", "c"], rng)
        choice.note(name, 0.5 * (rng.random() < success[name]), cost[name])
        drawn.append(name)
    shares = {name: drawn[100:].count(name) / 500 for name in PRIORS}
    assert shares["b"] > shares["c"] and shares["b"] > 0.45
    assert min(shares.values()) > 0.06


def test_only_possible_moves_are_drawn() -> None:
    rng, choice = np.random.default_rng(0), Choice(PRIORS, 100)
    assert {choice.draw(["b"], rng) for _ in range(20)} == {"b"}


def test_state_goes_on_and_impossible_ones_are_refused() -> None:
    original = Choice(PRIORS, 100)
    original.note("b", 3.0, 50)
    copy = Choice(PRIORS, 7)
    copy.load_state_dict(original.state_dict())
    names = list(PRIORS)
    np.testing.assert_array_equal(copy.probabilities(names), original.probabilities(names))
    state = original.state_dict()
    for wrong in ({"b": [0.0, 1.0]}, {"b": [1.0]}, {"b": [np.nan, 1.0]}, {"d": [1.0, 1.0]}):
        with pytest.raises(ValueError, match="choice"):
            copy.load_state_dict({**state, **wrong})
    with pytest.raises(ValueError, match="choice is no dict"):
        copy.load_state_dict([])  # type: ignore[arg-type]


def test_ten_thousand_vain_tries_leave_a_choice() -> None:
    choice = Choice(PRIORS, 100)
    for name in PRIORS:
        for _ in range(10_000):
            choice.note(name, 0.0, 100)
    choice.load_state_dict(choice.state_dict())
    np.testing.assert_allclose(choice.probabilities(list(PRIORS)), 1 / 3)
    choice.note("b", 0.1, 100)
    assert choice.probabilities(list(PRIORS))[1] > 0.79


def test_a_move_that_is_added_anywhere_takes_no_other_ones_gain() -> None:
    earlier = Choice({"a": 0.5, "c": 0.1}, 100)
    earlier.note("a", 0.7, 30)
    earlier.note("c", 0.9, 40)
    now, expected = Choice(PRIORS, 100), Choice(PRIORS, 100)
    now.note("b", 1.0, 1)  # which the state does not know
    now.load_state_dict(earlier.state_dict())
    expected.note("a", 0.7, 30)
    expected.note("c", 0.9, 40)
    assert now.state_dict() == expected.state_dict()
