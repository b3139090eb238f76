"""Candidates that are asked beyond a generation that waits for its own."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.population import CandidateRole, Population
from fide_plugins.types import Float64

from .conftest import drawn, hand_out, reloaded


def drawn_for_a_test(size: int, spare: int, again: int = 0) -> tuple[Population, list[Float64]]:
    """A generation that waits for its own candidates, and spare ones that were asked beyond it."""
    population = Population()
    x = np.random.default_rng(0).random((size + spare, 2))
    population.draw(x[:size], x[:size])
    xs = hand_out(population, size)
    population.draw(x[size:], x[size:], spare=True)
    return population, xs + hand_out(population, spare - again)


def test_spare_candidates_do_not_count() -> None:
    population, xs = drawn_for_a_test(4, 3)
    assert population.size == 4
    for x in (xs[4], xs[0], xs[5], xs[2], xs[6], xs[3]):
        candidate = population.record(x, 1.0)
        assert candidate is not None and not population.complete
    population.record(xs[1], 0.5)
    assert population.complete
    members, losses = population.close_generation()
    assert [c.index for c in members] == [0, 1, 2, 3]
    np.testing.assert_array_equal(losses, [1.0, 0.5, 1.0, 1.0])
    assert not population.complete and len(population.told) == 0


def test_a_spare_candidate_counts_in_the_place_of_one_that_was_withdrawn() -> None:
    population, xs = drawn_for_a_test(4, 4)
    population.withdraw(xs[1])
    population.withdraw(xs[7])  # which was spare itself, and is missed by nobody
    for x in (xs[0], xs[2], xs[3]):
        assert not population.complete
        population.record(x, 1.0)
    assert not population.complete
    population.record(xs[5], 0.0)
    assert population.complete
    members, _ = population.close_generation()
    assert [c.index for c in members] == [0, 2, 3], "nothing is learned from a spare one"
    population.draw(np.zeros((1, 2)), np.zeros((1, 2)))
    hand_out(population, 1)
    population.record(np.zeros(2), 0.0)
    assert population.complete, "nothing of the last generation is missed in the next"


def test_a_generation_whose_candidates_are_lost_is_completed_by_spare_ones() -> None:
    """After twice its size; or twice as many as are pending, so that slow ones are waited for."""
    population, xs = drawn_for_a_test(4, 8)
    population.record(xs[0], 3.0)
    for i, x in enumerate(xs[4:]):
        assert population.complete == (i >= 8)
        population.record(x, 1.0)
    assert population.complete
    members, losses = population.close_generation()
    assert [c.index for c in members] == [0] and losses == [3.0]

    population, xs = drawn_for_a_test(2, 30)
    told = 0
    while not population.complete:
        population.record(xs[2 + told], float(told))
        told += 1
    assert 2 * (32 - told) <= told < 30
    members, _ = population.close_generation()
    assert len(members) == told, "if not one came back, the others are all that is known"


@pytest.mark.parametrize("saved", [False, True])
def test_what_is_later_than_all_others_is_not_awaited(saved: bool) -> None:
    population, generation = Population(), 0
    rng = np.random.default_rng(0)
    while generation < 20:  # of each generation one is lost, and all others come at once
        x = rng.random((10, 2))
        population.draw(x, x)
        for row in hand_out(population, 10)[1:]:
            population.record(row, 0.0)
        population.close_generation()
        generation += 1
    if saved:
        population = reloaded(population, 2)
    assert len(population.pending) == 20
    assert 1 <= population.awaited <= 4


def test_a_step_counts_in_no_generation() -> None:
    """Told or withdrawn, beside members that were withdrawn or not."""
    population = drawn(4)
    xs, steps = hand_out(population, 4), np.array([[0.11, 0.2], [0.12, 0.2], [0.13, 0.2]])
    for x in steps:
        population.adopt(x, x, CandidateRole.STEP)
    assert len(population.pending) == 7
    candidate = population.record(steps[0], 0.0)
    assert candidate is not None and candidate.role is CandidateRole.STEP
    population.withdraw(steps[1])
    population.withdraw(xs[0])
    assert population.missing == 4 and len(population.pending) == 4
    for x in (steps[2], *xs[1:]):
        assert not population.complete
        population.record(x, 1.0)
    assert population.missing == 1 and not population.complete
    assert len(population.members()[0]) == 3
