"""The inverse and the forward model side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.proposers.ensemble import FORWARD, INVERSE, EnsembleProposer
from fide_plugins.proposers.forward import ForwardProposer
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.types import Float64

D, T, C = 3, 4, 5
STD = np.full(D, 0.1)
MEAN = np.full(D, 0.5)
MIXING = np.random.default_rng(1).standard_normal((D, T * C))


def make(**settings: Any) -> EnsembleProposer:
    inverse = LinearProposer(D, capacity=20, minimum=10)
    return EnsembleProposer(inverse, ForwardProposer(D, minimum=5), **settings)


def images_of(x: Float64) -> Tensor:
    return torch.as_tensor(((x - 0.5) @ MIXING).reshape(len(x), T, C))


def taught(n: int = 20, **settings: Any) -> EnsembleProposer:
    proposer = make(**settings)
    teach(proposer, n)
    return proposer


def teach(proposer: EnsembleProposer, n: int, seed: int = 0) -> None:
    x = np.random.default_rng(seed).normal(MEAN, STD, (n, D))
    proposer.update(x, images_of(x), np.square(x - 0.6).sum(axis=1), STD)


TARGET = images_of(np.full((1, D), 0.6))[0]
Z = np.random.default_rng(5).normal(MEAN, STD, (40, D))


def test_each_candidate_is_that_of_its_maker() -> None:
    proposer = taught()
    makers = np.where(np.arange(40) % 3, FORWARD, INVERSE)
    x = proposer.propose_by(makers, Z, TARGET, MEAN, STD, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    for maker, alone in ((INVERSE, proposer.inverse), (FORWARD, proposer.forward)):
        mine = makers == maker
        np.testing.assert_array_equal(x[mine], alone.propose(Z[mine], TARGET, MEAN, STD, rng))


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.9])
def test_makers_are_drawn_by_the_fraction(fraction: float) -> None:
    proposer = taught(fraction=fraction)
    makers = proposer.choose(4000, np.random.default_rng(0))
    assert set(makers.tolist()) == {INVERSE, FORWARD}
    assert (makers == FORWARD).mean() == pytest.approx(fraction, abs=0.03)
    made = proposer.proposals(Z, TARGET, MEAN, STD, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(made.makers, proposer.choose(40, rng))


def test_who_is_not_ready_proposes_nothing() -> None:
    proposer = make()
    assert not proposer.ready
    teach(proposer, 5)
    assert proposer.ready and not proposer.inverse.ready
    assert (proposer.choose(50, np.random.default_rng(0)) == FORWARD).all()


def test_the_fraction_follows_the_ranks_and_starves_nobody() -> None:
    losses, makers = np.arange(10.0), np.array([0, 2, 2, 0, 1, 1, 0, 0, 0, 0])
    proposer = make(smallest=0.1, rate=0.2)
    proposer.note_ranks(losses, makers)
    assert proposer.fraction == pytest.approx(0.5 + 0.2 * 2 / 2)  # mean ranks 0.5 and 2.5 of four
    for _ in range(50):
        proposer.note_ranks(losses, makers)
    assert proposer.fraction == pytest.approx(0.9)
    for _ in range(100):
        proposer.note_ranks(-losses, makers)
    assert proposer.fraction == pytest.approx(0.1)


@pytest.mark.parametrize("makers", [[0, 0, 0], [1, 1, 0], [2, 2, 2]])
def test_one_kind_alone_says_nothing(makers: list[int]) -> None:
    proposer = make()
    proposer.note_ranks(np.arange(3.0), np.array(makers))
    assert proposer.fraction == 0.5


def test_losses_that_are_not_finite_rank_last_together() -> None:
    one, other = make(), make()
    one.note_ranks(np.array([np.inf, np.inf, 0.0, 1.0]), np.array([1, 2, 1, 2]))
    other.note_ranks(np.array([np.inf, np.inf, 0.0, 1.0]), np.array([2, 1, 1, 2]))
    assert one.fraction == other.fraction < 0.5


def test_state_and_copy() -> None:
    first = taught()
    first.note_ranks(np.arange(4.0), np.array([2, 2, 1, 1]))
    second, third = make(), first.copy()
    second.load_state_dict(first.state_dict())
    before = first.proposals(Z, TARGET, MEAN, STD, np.random.default_rng(0))
    for other in (second, third):
        made = other.proposals(Z, TARGET, MEAN, STD, np.random.default_rng(0))
        np.testing.assert_array_equal(made.x, before.x)
        np.testing.assert_array_equal(made.makers, before.makers)
        teach(other, 7, seed=1)
        other.note_ranks(np.arange(4.0), np.array([1, 1, 2, 2]))
    again = first.proposals(Z, TARGET, MEAN, STD, np.random.default_rng(0))
    np.testing.assert_array_equal(again.x, before.x)
    np.testing.assert_array_equal(second.forward._x, third.forward._x)
    assert second.fraction == third.fraction != first.fraction
