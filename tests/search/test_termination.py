"""When a search is over."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.search.one_search import Termination, has_stalled, is_hopeless

WIDE = np.full(4, 0.1)
INF = float("inf")


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
        ([INF, 1, 1, 1, 1, 1], False),
        ([INF] * 6, True),
    ],
)
def test_stall(history: list[float], stalled: bool) -> None:
    with np.errstate(all="raise"):
        assert has_stalled(history, 5, 0.01) == stalled


@pytest.mark.parametrize(
    ("history", "goal", "hopeless"),
    [
        ([8.0, 7, 6, 5, 4, 3], 0.0, False),  # 1 a generation: 0 is 3 generations away
        ([8.0, 7, 6, 5, 4, 3], -4.9, False),
        ([8.0, 7, 6, 5, 4, 3], -5.1, True),  # 8.1 generations away
        ([8.0, 7, 6, 5, 4], -100.0, False),  # too early to tell
        ([3.0] * 6, 2.0, True),
        ([3.0] * 6, 3.0, False),  # it is there
        ([3.0] * 6, INF, False),  # nothing to beat
        ([INF] * 6, 1.0, True),
        ([INF] * 5 + [9.0], 1.0, False),
    ],
)
def test_hope(history: list[float], goal: float, hopeless: bool) -> None:
    with np.errstate(all="raise"):
        assert is_hopeless(history, goal) == hopeless


def test_a_search_that_stalls_is_over() -> None:
    progress = Termination(sigma0=1 / 6, patience=5, improvement=0.01)
    for generation in range(6):
        assert not progress.is_over(WIDE), generation
        progress.note(np.array([3.0, 1.0, np.inf, 2.0]))
    assert progress.history == [1.0] * 6
    assert progress.is_over(WIDE)


def test_a_search_with_something_to_beat_is_over_sooner() -> None:
    free = Termination(sigma0=1 / 6, patience=15, improvement=0.1)
    bound = Termination(sigma0=1 / 6, patience=15, improvement=0.1, goal=0.5)
    for _ in range(6):
        assert not bound.is_over(WIDE)
        for progress in (free, bound):
            progress.note(np.ones(3))
    assert bound.is_over(WIDE) and not free.is_over(WIDE)


def test_a_search_by_losses_alone_ends_when_it_has_converged_or_nothing_is_better() -> None:
    """A tenth in ten generations is enough for a search that images guide, and too much to ask."""
    progress = Termination(sigma0=1.0, patience=10, improvement=0.1, loss_only_patience=30)
    for generation in range(100):
        progress.note(np.array([1.0 - 1e-6 * generation]))
    assert progress.is_over(np.array([0.5])) and not progress.is_over(np.array([0.5]), guided=False)
    assert not progress.is_over(np.array([1e-10, 1e-12]), guided=False)
    assert progress.is_over(np.array([9e-12, 1e-12]), guided=False)
    for generation in range(30):
        assert not progress.is_over(np.array([0.5]), guided=False), generation
        progress.note(np.array([7.0]))
    assert progress.is_over(np.array([0.5]), guided=False)


@pytest.mark.parametrize(
    ("rate", "above", "over"),
    [
        (0.96, 0.0, True),  # a quarter in seven generations is too little
        (0.96, 100.0, False),
        (0.9, 0.0, False),
        (1.0, INF, True),  # the usual rule
    ],
)
def test_a_search_above_a_loss_has_to_be_quick(rate: float, above: float, over: bool) -> None:
    search = Termination(sigma0=1 / 6, patience=5, improvement=0.1, strict_above=above)
    verdicts = []
    for generation in range(12):
        search.note(np.array([10.0 * rate**generation]))
        verdicts.append(search.is_over(WIDE))
    assert any(verdicts) == over
    assert not any(verdicts[:5])
