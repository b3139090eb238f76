"""The share that is proposed follows the ranks."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.points import Float64
from fide_plugins.proposers.share import adapt_share


def adapt(losses: Float64, proposed: list[int], share: float = 0.5, **limits: float) -> float:
    mask = np.zeros(len(losses), bool)
    mask[proposed] = True
    bounds = {"smallest": 0.1, "largest": 0.9, "rate": 0.2} | limits
    return adapt_share(share, losses, mask, **bounds)


def test_moves_by_the_rate_where_one_kind_is_ahead_throughout() -> None:
    """Then the mean ranks differ by k / 2."""
    losses = np.arange(8.0)
    assert adapt(losses, [0, 1, 2, 3]) == pytest.approx(0.7)
    assert adapt(losses, [4, 5, 6, 7]) == pytest.approx(0.3)
    assert adapt(losses, [0]) == pytest.approx(0.7)
    assert adapt(losses, [7]) == pytest.approx(0.3)


def test_stays_where_they_are_alike() -> None:
    assert adapt(np.arange(4.0), [0, 3]) == pytest.approx(0.5)
    assert adapt(np.array([3.0, 1.0, 2.0, 4.0]), [0, 2]) == pytest.approx(0.5)


@pytest.mark.parametrize("proposed", [[], [0, 1, 2, 3]])
def test_a_generation_of_one_kind_says_nothing(proposed: list[int]) -> None:
    assert adapt(np.arange(4.0), proposed) == 0.5


def test_stays_within_its_limits() -> None:
    share = 0.5
    for _ in range(50):
        share = adapt(np.arange(4.0), [3], share)
    assert share == 0.1
    for _ in range(50):
        share = adapt(np.arange(4.0), [0], share)
    assert share == 0.9


def test_only_the_order_counts() -> None:
    losses = np.array([0.3, 0.1, 0.4, 0.15])
    assert adapt(losses, [1]) == adapt(1e-300 * losses, [1]) == adapt(np.exp(losses), [1])


def test_losses_that_are_all_infinite_say_nothing() -> None:
    assert adapt(np.full(6, np.inf), [0, 1]) == pytest.approx(0.5)
    assert adapt(np.full(6, np.inf), [4, 5]) == pytest.approx(0.5)


def test_rate_0_keeps_it() -> None:
    assert adapt(np.arange(4.0), [0], rate=0.0) == 0.5


def test_failures_cost_a_proposer_as_much_as_the_worst_losses() -> None:
    losses = np.arange(10.0)
    worst = adapt(losses, [9])
    failed = adapt(np.where(losses == 9, np.inf, losses), [9])
    assert failed == pytest.approx(worst)
    tied = adapt(np.where(losses >= 8, np.inf, losses), [8, 9])
    assert tied == pytest.approx(adapt(losses, [8, 9]))
