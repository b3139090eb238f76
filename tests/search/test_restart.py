"""When a search is over, and where the next one begins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.points import Float64
from fide_plugins.search.restart import (
    Restarts,
    has_stalled,
    is_hopeless,
    overlap,
    related_parameters,
)

WIDE = np.full(4, 0.1)


def restarts(**changes: Any) -> Restarts:
    options: dict[str, Any] = {
        "mode": "partial",
        "patience": 5,
        "improvement": 0.01,
        "horizon": 8,
        "group_std": 0.15,
        "rest_std": 0.01,
    }
    return Restarts(4, 1 / 6, **(options | changes))


@pytest.mark.parametrize(
    ("history", "stalled"),
    [
        ([1.0] * 5, False),  # too short to tell
        ([1.0] * 6, True),
        ([1.0, 1, 1, 1, 1, 0.98], False),
        ([1.0, 1, 1, 1, 1, 0.995], True),
        ([9.0, 1, 1, 1, 1, 1, 1], True),  # only the last generations count
        ([-1.0, -1, -1, -1, -1, -1.02], False),  # a loss may be negative
        ([-1.0, -1, -1, -1, -1, -1.005], True),
        ([0.0] * 6, True),  # nothing is better than nothing
        ([np.inf, 1, 1, 1, 1, 1], False),
        ([np.inf] * 6, True),
    ],
)
def test_stall(history: list[float], stalled: bool) -> None:
    with np.errstate(all="raise"):
        assert has_stalled(history, 5, 0.01) == stalled


def test_hopeless_at_the_rate_of_the_last_generations() -> None:
    """8, 4, 2, 1 halves a generation: 8 more generations reach 1/256."""
    falling = [8.0, 4.0, 2.0, 1.0]
    assert not is_hopeless(falling, 1 / 255, horizon=8)
    assert is_hopeless(falling, 1 / 257, horizon=8)
    assert not is_hopeless(falling, 2.0, horizon=0)  # there already
    assert not is_hopeless(falling[:3], 1e-9, horizon=8)  # too short to tell
    assert is_hopeless([1.0] * 4, 0.99, horizon=10_000)
    assert not is_hopeless([np.inf, 4, 2, 1], 1e-9, horizon=8)
    assert not is_hopeless([1.0, 1, 1, -1], -2.0, horizon=8)  # a rate has no meaning


def test_overlap_is_the_cosine_of_regions() -> None:
    energy = np.array([[1.0, 2.0, 0.0, 1.0], [0.0, 0.0, 3.0, 1.0]])
    half = np.sqrt(0.5)
    expected = [[1, 1, 0, half], [1, 1, 0, half], [0, 0, 1, half], [half, half, half, 1]]
    np.testing.assert_allclose(overlap(energy), expected, atol=1e-12)
    assert np.isfinite(overlap(np.zeros((3, 2)))).all()


def test_related_parameters_follow_with_the_probability_of_their_overlap() -> None:
    overlaps = np.array([[1.0, 0.7, 0.0], [0.7, 1.0, 0.2], [0.0, 0.2, 1.0]])
    rng = np.random.default_rng(0)
    groups = np.array([related_parameters(overlaps, rng) for _ in range(6000)])
    assert groups.any(axis=1).all()
    probability = overlaps / 3  # each is drawn first in a third of all cases
    np.testing.assert_allclose(groups.mean(axis=0), probability.sum(axis=0), atol=0.03)
    together = (groups[:, 0] & groups[:, 1]).mean()
    assert together == pytest.approx((0.7 + 0.7) / 3, abs=0.03)


def test_parameters_that_move_nothing_are_not_drawn_along() -> None:
    energy = np.zeros((2, 4))
    energy[:, 0] = 1.0
    rng = np.random.default_rng(0)
    groups = [related_parameters(overlap(energy), rng) for _ in range(100)]
    assert all(group.sum() == 1 for group in groups)


@pytest.mark.parametrize("mode", ["partial", "full", "none"])
def test_a_stalled_search_is_over_unless_there_is_only_one(mode: str) -> None:
    policy = restarts(mode=mode)
    policy.begin_full()
    for generation in range(6):
        assert not policy.is_over(WIDE), generation
        policy.note(np.array([3.0, 1.0, np.inf, 2.0]))
    assert policy.is_over(WIDE) == (mode != "none")


def test_a_collapsed_search_is_over() -> None:
    policy = restarts()
    policy.begin_full()
    assert policy.is_over(np.full(4, 1e-9))
    assert not policy.is_over(np.array([1e-9, 1e-9, 1e-9, 0.1]))


def test_a_full_restart_knows_nothing() -> None:
    mean, std = restarts().begin_full()
    np.testing.assert_array_equal(mean, np.full(4, 0.5))
    np.testing.assert_array_equal(std, np.full(4, 1 / 6))


def energy_of_pairs() -> Float64:
    """Parameters 0 and 1 move the left half, 2 and 3 the right half."""
    return np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])


def test_a_partial_restart_frees_one_group_at_the_best_point() -> None:
    best = np.array([0.1, 0.2, 0.3, 0.4])
    seen = set()
    for seed in range(20):
        policy = restarts()
        policy.begin_full()
        policy.note(np.array([1.0, 2.0]))
        rng = np.random.default_rng(seed)
        mean, std = policy.begin_next(best, 1.0, energy_of_pairs(), rng)
        np.testing.assert_array_equal(mean, best)
        assert mean is not best
        seen.add(tuple(std.tolist()))
        assert policy.searches == 2
    assert seen == {(0.15, 0.15, 0.01, 0.01), (0.01, 0.01, 0.15, 0.15)}


def test_without_images_a_restart_is_full() -> None:
    policy = restarts()
    policy.begin_full()
    policy.note(np.ones(3))
    mean, std = policy.begin_next(np.zeros(4), 1.0, None, np.random.default_rng(0))
    np.testing.assert_array_equal(mean, np.full(4, 0.5))
    np.testing.assert_array_equal(std, np.full(4, 1 / 6))


def test_state_goes_on_where_it_was() -> None:
    original, copy = restarts(), restarts()
    original.begin_full()
    original.note(np.array([1.0, 2.0]))
    original.begin_next(np.full(4, 0.2), 1.0, energy_of_pairs(), np.random.default_rng(0))
    original.note(np.array([4.0, 5.0]))
    copy.load_state_dict(original.state_dict())
    for policy in (original, copy):
        policy.note(np.array([3.0]))
    for key, value in original.state_dict().items():
        np.testing.assert_array_equal(value, copy.state_dict()[key])
    results = [
        policy.begin_next(np.full(4, 0.9), 0.5, None, np.random.default_rng(3))
        for policy in (original, copy)
    ]
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
