"""What every proposer promises, as `make_proposer` makes it."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins import encoders
from fide_plugins.options import make_options
from fide_plugins.proposers import Proposer, make_proposer
from fide_plugins.types import Float64

D, T, C, K = 6, 4, 16, 5
MEAN, STD = np.full(D, 0.5), np.linspace(0.05, 0.2, D)
MIXING = np.random.default_rng(1).standard_normal((D, T * C))
TARGET_X = np.full((1, D), 0.6)
OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "linear": ("balanced", {"proposer": "linear"}),
    "linear, screening": ("balanced", {"proposer": "linear", "screening": True}),
    "diffusion": ("paper", {"epochs": 1, "batch_size": 10}),
}
Make = Callable[..., Proposer]


@pytest.fixture(params=OPTIONS)
def make(request: pytest.FixtureRequest) -> Make:
    options = make_options(*OPTIONS[request.param])

    def factory(seed: int = 0) -> Proposer:
        proposer = make_proposer(options, D, K, seed, encoders.make("dense"))
        assert proposer is not None
        return proposer

    return factory


def images_of(x: Float64) -> Tensor:
    flat = (x - 0.5) @ MIXING
    tokens = (flat + 0.5 * np.sin(3 * flat)).reshape(len(x), T, C)
    return torch.as_tensor(tokens, dtype=torch.float32)


def scene(seed: int = 0, n: int = 3 * K) -> tuple[Float64, Tensor, Float64, Float64]:
    """Candidates, their tokens and losses, and the deviation of the search, as `update` takes."""
    x = np.random.default_rng(seed).normal(MEAN, STD, (n, D))
    return x, images_of(x), np.square(x - TARGET_X).sum(axis=1), STD


def proposed(proposer: Proposer, m: int = 4, std: Float64 = STD) -> Float64:
    rng = np.random.default_rng(7)
    z = rng.normal(MEAN, std, (m, D))
    return proposer.propose(z, images_of(TARGET_X)[0], MEAN, std, rng)


def test_proposals_are_points_and_not_the_samples(make: Make) -> None:
    proposer = make()
    proposer.update(*scene())
    assert proposer.ready
    points = proposed(proposer)
    assert points.shape == (4, D) and points.dtype == np.float64 and np.isfinite(points).all()
    assert (points != np.random.default_rng(7).normal(MEAN, STD, (4, D))).any()


def test_the_same_seed_gives_the_same_proposals(make: Make) -> None:
    one, other = make(3), make(3)
    for proposer in (one, other):
        for seed in range(2):
            proposer.update(*scene(seed))
    np.testing.assert_array_equal(proposed(one), proposed(other))


@pytest.mark.parametrize("updates", [0, 1, 2])
def test_a_state_goes_on_bit_for_bit(make: Make, updates: int) -> None:
    """The state is a copy, and replaces what was learned before."""
    one, other = make(3), make(99)
    for seed in range(updates):
        one.update(*scene(seed))
    other.update(*scene(9))
    state = one.state_dict()
    kept = deepcopy(state)
    one.update(*scene(5))
    other.load_state_dict(kept)
    other.update(*scene(5))
    np.testing.assert_array_equal(proposed(one), proposed(other))
    again = make(99)
    again.load_state_dict(state)  # which later updates have not changed
    again.update(*scene(5))
    np.testing.assert_array_equal(proposed(one), proposed(again))


def test_what_is_no_state_is_refused(make: Make) -> None:
    for odd in ({}, {"x": np.zeros(3)}):
        with pytest.raises((ValueError, KeyError)):
            make().load_state_dict(odd)


def test_what_is_given_is_not_changed(make: Make) -> None:
    given, proposer = scene(), make()
    before = deepcopy(given)
    proposer.update(*given)
    proposed(proposer)
    for one, kept in zip(given, before, strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(kept))


@pytest.mark.parametrize("std", [STD, np.full(D, 1e-14), np.r_[1e-200, STD[1:]]])
@pytest.mark.parametrize("kind", ["one point", "one image", "noise", "near", "losses equal"])
def test_proposals_are_finite_whatever_was_told(make: Make, kind: str, std: Float64) -> None:
    x, tokens, losses, _ = scene()
    rng = np.random.default_rng(0)
    if kind == "one point":
        x = np.tile(x[:1], (len(x), 1))
    elif kind == "one image":
        tokens = tokens[:1].repeat(len(x), 1, 1)
    elif kind == "noise":
        tokens = torch.as_tensor(rng.random(tuple(tokens.shape)), dtype=torch.float32)
    elif kind == "near":
        x = x[:1] + 1e-15 * rng.random(x.shape)
    else:
        losses = np.zeros(len(x))
    proposer = make()
    proposer.update(x, tokens, losses, std)
    assert np.isfinite(proposed(proposer, std=std)).all()
