"""The bookkeeping of generations."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins import ledger as ledger_module
from fide_plugins.ledger import Ledger
from fide_plugins.points import Float64

PROPOSED = 2  # of each generation, the last ones


def drawn(popsize: int, seed: int = 0, ledger: Ledger | None = None) -> Ledger:
    ledger = ledger or Ledger()
    x = np.random.default_rng(seed).random((popsize, 2))
    n = popsize - PROPOSED
    ledger.draw(x[:n], x[:n] + 2.0, PROPOSED, lambda: (x[n:], x[n:] + 2.0))
    return ledger


def hand_out(ledger: Ledger, n: int) -> list[Float64]:
    return [ledger.hand_out() for _ in range(n)]


def test_members_are_in_the_order_of_asking_whatever_that_of_telling() -> None:
    closed = []
    for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):
        ledger = drawn(5)
        xs = hand_out(ledger, 5)
        for i in order:
            assert not ledger.complete
            assert ledger.take_back(xs[i], float(10 + i)) == i
        assert ledger.complete
        closed.append(ledger.close_generation())
        assert not ledger.complete
    for members, losses in closed:
        assert [c.index for c in members] == [0, 1, 2, 3, 4]
        np.testing.assert_array_equal(losses, [10, 11, 12, 13, 14])
        assert [c.proposed for c in members] == [False, False, False, True, True]
        assert not any(c.late for c in members)
        for c in members:
            np.testing.assert_array_equal(c.z, c.x + 2.0)


def test_left_and_asked_count() -> None:
    ledger = drawn(5)
    assert (ledger.left, ledger.asked) == (5, 0)
    xs = hand_out(ledger, 3)
    assert (ledger.left, ledger.asked) == (2, 3)
    ledger.take_back(xs[1], 0.0)
    assert (ledger.left, ledger.asked) == (2, 2)


def test_proposals_are_made_when_the_first_of_them_is_due_and_only_then() -> None:
    ledger, made = Ledger(), []
    x = np.linspace(0, 1, 5)[:, None]

    def propose() -> tuple[Float64, Float64]:
        made.append(ledger.left)
        return x[3:], x[3:]

    ledger.draw(x[:3], x[:3], 2, propose)
    assert (ledger.size, ledger.left, ledger.at_hand, ledger.drawn) == (5, 5, 3, 5)
    hand_out(ledger, 3)
    assert (ledger.left, ledger.at_hand, made) == (2, 2, [])
    assert hand_out(ledger, 2) == [x[3], x[4]] and made == [2]
    assert [ledger.take_back(row, 0.0) for row in x] == [0, 1, 2, 3, 4]
    ledger.draw(x[:3], x[:3], 2, propose)
    ledger.close_generation()
    assert (ledger.left, made) == (0, [2])  # thrown away, and so never made


def test_proposals_that_fail_are_tried_again() -> None:
    ledger, answers = Ledger(), iter([ArithmeticError, None])

    def propose() -> tuple[Float64, Float64]:
        error = next(answers)
        if error is not None:
            raise error
        return np.ones((1, 2)), np.ones((1, 2))

    ledger.draw(np.zeros((1, 2)), np.zeros((1, 2)), 1, propose)
    hand_out(ledger, 1)
    with pytest.raises(ArithmeticError):
        ledger.hand_out()
    assert (ledger.left, ledger.asked) == (1, 1)
    np.testing.assert_array_equal(ledger.hand_out(), [1.0, 1.0])


def test_what_was_never_asked_or_told_twice_is_a_guest() -> None:
    ledger = drawn(4)
    xs = hand_out(ledger, 2)
    assert ledger.take_back(np.array([0.5, 0.5]), 1.0) is None
    assert ledger.take_back(xs[0], 1.0) == 0
    assert ledger.take_back(xs[0], 1.0) is None
    not_handed_out = np.random.default_rng(0).random((4, 2))[3]
    assert ledger.take_back(not_handed_out, 1.0) is None


def test_equal_candidates_are_told_apart_by_count() -> None:
    ledger = Ledger()
    same = np.array([0.25, 0.75])
    ledger.draw(np.array([same, same]), np.zeros((2, 2)))
    hand_out(ledger, 2)
    assert [ledger.take_back(same, 1.0) for _ in range(3)] == [0, 1, None]


def test_a_late_candidate_counts_in_the_generation_in_which_it_arrives() -> None:
    """Six workers, generations of four: two come back after the first is complete."""
    ledger = drawn(4)
    xs = hand_out(ledger, 4)
    drawn(4, seed=1, ledger=ledger)
    xs += hand_out(ledger, 2)
    for i in (0, 2, 4, 5):
        assert ledger.take_back(xs[i], 0.0) == i
    members, _ = ledger.close_generation()
    assert [c.index for c in members] == [0, 2, 4, 5] and not any(c.late for c in members)
    assert ledger.left == 0  # two of the second draw are thrown away
    drawn(4, seed=2, ledger=ledger)
    fresh = hand_out(ledger, 2)
    assert ledger.take_back(xs[3], 7.0) == 3
    assert ledger.take_back(fresh[1], 8.0) == 9
    assert ledger.take_back(xs[1], 9.0) == 1
    assert ledger.take_back(fresh[0], 6.0) == 8
    members, losses = ledger.close_generation()
    assert [(c.index, c.late) for c in members] == [(1, True), (3, True), (8, False), (9, False)]
    np.testing.assert_array_equal(losses, [9.0, 7.0, 6.0, 8.0])


def test_after_a_restart_what_is_still_out_becomes_a_guest() -> None:
    ledger = drawn(4)
    old = hand_out(ledger, 4)
    ledger.close_search()
    drawn(4, seed=1, ledger=ledger)
    new = hand_out(ledger, 1)
    assert ledger.take_back(old[0], 1.0) is None
    assert ledger.take_back(new[0], 1.0) == 4
    assert ledger.asked == 0  # those that never come back are not remembered for ever


@pytest.mark.parametrize("told", [0, 2])
def test_state_goes_on(told: int) -> None:
    """With a queue, candidates outside, late ones, and results."""
    original = drawn(4)
    xs = hand_out(original, 4)
    drawn(4, seed=1, ledger=original)
    xs += hand_out(original, 3)
    for i in range(4):
        original.take_back(xs[i], float(i))
    original.close_generation()
    drawn(4, seed=2, ledger=original)
    xs += hand_out(original, 2)
    for i in range(told):
        original.take_back(xs[4 + i], -float(i))
    copy = Ledger.from_state(original.state_dict())
    outcomes = []
    for ledger in (original, copy):
        assert (ledger.left, ledger.asked, ledger.drawn) == (2, 5 - told, 12)
        rest = [x.tolist() for x in hand_out(ledger, 2)]
        indices = [ledger.take_back(x, 0.5) for x in xs[4 + told :]]
        members, losses = ledger.close_generation()
        listed = [(c.index, c.x.tolist(), c.z.tolist(), c.proposed, c.late) for c in members]
        outcomes.append((rest, indices, listed, losses.tolist()))
    assert outcomes[0] == outcomes[1]


def test_an_empty_ledger_has_a_state() -> None:
    copy = Ledger.from_state(Ledger().state_dict())
    assert (copy.size, copy.left, copy.asked, copy.drawn) == (0, 0, 0, 0)
    assert not copy.complete


def test_generations_may_differ_in_size() -> None:
    ledger = drawn(3)
    for size in (5, 2, 7):
        for x in hand_out(ledger, ledger.left):
            assert not ledger.complete
            ledger.take_back(x, 0.0)
        assert ledger.complete
        ledger.close_generation()
        drawn(size, seed=size, ledger=ledger)
        assert ledger.left == size


def test_what_never_comes_back_is_given_up_the_oldest_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ledger_module, "_MOST_OUT", 10)
    ledger = Ledger()
    x = np.linspace(0, 1, 25)[:, None]
    for rows in np.split(x, 5):
        ledger.draw(rows, rows)
        for _ in rows:
            ledger.hand_out()
    assert ledger.asked == len(ledger.state_dict()["asked"]["index"]) == 10
    assert ledger.take_back(x[14], 0.0) is None
    assert ledger.take_back(x[15], 0.0) == 15
    assert ledger.asked == Ledger.from_state(ledger.state_dict()).asked == 9


def test_zero_may_come_back_with_a_sign() -> None:
    ledger = Ledger()
    x = np.array([[0.0, 0.5]])
    ledger.draw(x, x)
    ledger.hand_out()
    assert ledger.take_back(np.array([-0.0, 0.5]), 1.0) == 0
