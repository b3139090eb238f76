"""When a search is over, and where the next one begins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.search.restart import Restarts, has_stalled

WIDE = np.full(4, 0.1)


def restarts(**changes: Any) -> Restarts:
    options: dict[str, Any] = {"patience": 5, "improvement": 0.01}
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


@pytest.mark.parametrize("enabled", [True, False])
def test_a_stalled_search_is_over_unless_there_is_only_one(enabled: bool) -> None:
    policy = restarts(enabled=enabled)
    policy.begin()
    for generation in range(6):
        assert not policy.is_over(WIDE), generation
        policy.note(np.array([3.0, 1.0, np.inf, 2.0]))
    assert policy.is_over(WIDE) == enabled


def test_a_collapsed_search_is_over() -> None:
    policy = restarts()
    policy.begin()
    assert policy.is_over(np.full(4, 1e-9))
    assert not policy.is_over(np.array([1e-9, 1e-9, 1e-9, 0.1]))


def test_a_restart_knows_nothing() -> None:
    policy = restarts()
    for search in (1, 2, 3):
        mean, std = policy.begin()
        np.testing.assert_array_equal(mean, np.full(4, 0.5))
        np.testing.assert_array_equal(std, np.full(4, 1 / 6))
        assert policy.searches == search
        for _ in range(6):
            assert not policy.is_over(WIDE)
            policy.note(np.ones(3))
        assert policy.is_over(WIDE)


def test_state_goes_on_where_it_was() -> None:
    original, copy = restarts(), restarts()
    original.begin()
    original.note(np.array([1.0, 2.0]))
    original.begin()
    original.note(np.array([4.0, 5.0]))
    copy.load_state_dict(original.state_dict())
    for policy in (original, copy):
        policy.note(np.array([3.0]))
    assert copy.searches == original.searches == 2
    for key, value in original.state_dict().items():
        np.testing.assert_array_equal(value, copy.state_dict()[key])
