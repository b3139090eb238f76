"""The bookkeeping of generations."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.population import Population, mirrored_pair
from fide_plugins.types import Float64

from .conftest import drawn, hand_out, index_of, reloaded


def test_members_are_in_the_order_of_asking_whatever_that_of_telling() -> None:
    closed = []
    for order in ([0, 1, 2, 3, 4], [3, 0, 4, 2, 1]):
        population = drawn(5)
        xs = hand_out(population, 5)
        for i in order:
            assert not population.complete
            assert index_of(population, xs[i], float(10 + i)) == i
        assert population.complete
        closed.append(population.close_generation())
        assert not population.complete
    for members, losses in closed:
        assert [c.index for c in members] == [0, 1, 2, 3, 4]
        np.testing.assert_array_equal(losses, [10, 11, 12, 13, 14])
        assert [c.proposed for c in members] == [False, False, False, True, True]
        assert not any(c.off_distribution for c in members)
        for c in members:
            np.testing.assert_array_equal(c.z, c.x + 2.0)


def test_remaining_and_pending_count() -> None:
    population = drawn(5)
    assert (population.remaining, len(population.pending)) == (5, 0)
    xs = hand_out(population, 3)
    assert (population.remaining, len(population.pending)) == (2, 3)
    population.record(xs[1], 0.0)
    assert (population.remaining, len(population.pending)) == (2, 2)


@pytest.mark.parametrize("saved", [False, True])
def test_proposals_take_the_places_of_the_samples_that_are_reserved_for_them(saved: bool) -> None:
    population = Population()
    x = np.linspace(0, 1, 5)[:, None]
    population.draw(x[:2], x[:2], x[2:])
    assert population.size == population.remaining == population.drawn == 5
    assert (len(population.queue), len(population.reserved)) == (2, 3)
    population.add_proposals(*2 * [population.reserved[:1]])
    if saved:
        population = reloaded(population, 1)
    np.testing.assert_array_equal(population.reserved, x[3:])
    population.replace(3, x[3:4] / 2, x[3:4], np.array([True]))
    population.add_proposals(*2 * [population.reserved])
    expected = [x[0], x[1], x[2], x[3] / 2, x[4]]
    assert hand_out(population, 5) == expected
    assert [index_of(population, row, 0.0) for row in expected] == [0, 1, 2, 3, 4]
    population.draw(x[:3], x[:3], x[3:])
    population.close_generation()
    assert population.remaining == 0  # thrown away


def test_what_was_never_asked_or_told_twice_is_injected() -> None:
    population = drawn(4)
    xs = hand_out(population, 2)
    assert index_of(population, np.array([0.5, 0.5]), 1.0) is None
    assert index_of(population, xs[0], 1.0) == 0
    assert index_of(population, xs[0], 1.0) is None
    not_handed_out = np.random.default_rng(0).random((4, 2))[3]
    assert index_of(population, not_handed_out, 1.0) is None


def test_a_late_candidate_counts_in_the_generation_in_which_it_arrives() -> None:
    """Six workers, generations of four: two come back after the first is complete."""
    population = drawn(4)
    xs = hand_out(population, 4)
    drawn(4, seed=1, population=population)
    xs += hand_out(population, 2)
    for i in (0, 2, 4, 5):
        assert index_of(population, xs[i], 0.0) == i
    members, _ = population.close_generation()
    assert [c.index for c in members] == [0, 2, 4, 5]
    assert not any(c.off_distribution for c in members)
    assert population.remaining == 0  # two of the second draw are thrown away
    drawn(4, seed=2, population=population)
    fresh = hand_out(population, 2)
    assert index_of(population, xs[3], 7.0) == 3
    assert index_of(population, fresh[1], 8.0) == 9
    assert index_of(population, xs[1], 9.0) == 1
    assert index_of(population, fresh[0], 6.0) == 8
    members, losses = population.close_generation()
    assert [c.index for c in members] == [1, 3, 8, 9]
    assert [c.off_distribution for c in members] == [True, True, False, False]
    np.testing.assert_array_equal(losses, [9.0, 7.0, 6.0, 8.0])


@pytest.mark.parametrize("told", [0, 2])
def test_state_goes_on(told: int) -> None:
    """With a queue, candidates outside, late ones, and results."""
    original = drawn(4)
    xs = hand_out(original, 4)
    drawn(4, seed=1, population=original)
    xs += hand_out(original, 3)
    for i in range(4):
        original.record(xs[i], float(i))
    original.close_generation()
    drawn(4, seed=2, population=original)
    xs += hand_out(original, 2)
    for i in range(told):
        original.record(xs[4 + i], -float(i))
    copy = reloaded(original, 2)
    outcomes = []
    for population in (original, copy):
        assert (population.remaining, population.drawn) == (2, 12)
        assert len(population.pending) == 5 - told
        rest = [x.tolist() for x in hand_out(population, 2)]
        indices = [index_of(population, x, 0.5) for x in xs[4 + told :]]
        members, losses = population.close_generation()
        listed = [
            (c.index, c.x.tolist(), c.z.tolist(), c.proposed, c.off_distribution) for c in members
        ]
        outcomes.append((rest, indices, listed, losses.tolist()))
    assert outcomes[0] == outcomes[1]


def awaited(population: Population, size: int) -> int:
    """How many are awaited in a generation of that size, also after saving."""
    population.size = size
    copy = reloaded(population, 1)
    assert copy.awaited == population.awaited and len(copy.pending) == len(population.pending)
    return population.awaited


def test_what_comes_back_rounded_is_the_candidate_that_was_asked() -> None:
    population = drawn(4)
    [x] = hand_out(population, 1)
    candidate = population.record(x.astype(np.float32).astype(np.float64), 1.0)
    assert candidate is not None
    np.testing.assert_array_equal(candidate.x, x)


def drawn_with_pair(population: Population, n: int) -> list[Float64]:
    """A generation of n candidates of two parameters, of which the first two are a pair."""
    x = np.random.default_rng(population.drawn).random((n, 2))
    population.draw(x, x, pair=True)
    return hand_out(population, n)


@pytest.mark.parametrize(
    ("told", "pair"),
    [
        ([5, 4, 3, 2, 1, 0], (0, 1)),
        ([1, 7, 4, 0, 3, 2], (0, 1)),
        ([0, 2, 3, 4, 5, 6], None),
        ([1, 2, 3, 4, 5, 7], None),
        ([0, 5, 7, 4, 6, 3], (4, 5)),  # one of the first pair was lost, none of the second
        ([1, 6, 2, 3, 4, 5], None),  # neighbors now, and yet of different pairs
    ],
)
def test_the_mirrored_pair_is_found_whatever_is_lost(
    told: list[int], pair: tuple[int, int] | None
) -> None:
    """Of two draws of six from the same distribution, of which any six complete the generation."""
    population = Population()
    xs = drawn_with_pair(population, 6) + drawn_with_pair(population, 6)
    for i in told:
        population.record(xs[i], 0.0)
    members, _ = population.close_generation()
    assert mirrored_pair(members) == pair
