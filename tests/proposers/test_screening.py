"""Local regressions: against explicit features, and what they are for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, encoders
from fide_plugins.options import make_options
from fide_plugins.proposers import make_proposer, screening
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.proposers.screening import local_regressions, token_weights
from fide_plugins.types import Float64

D, T, C = 12, 40, 3
STD = np.full(D, 0.1)


def local_images(x: Float64, seed: int = 0) -> Float64:
    """(n, T * C): each parameter changes three tokens of its own, all tokens have some noise."""
    rng = np.random.default_rng(seed)
    e = 0.01 * rng.standard_normal((len(x), T, C))
    mixing = np.random.default_rng(7).standard_normal((D, 3, C))
    for p in range(D):
        e[:, 3 * p : 3 * p + 3] += (x[:, p] - 0.5)[:, None, None] * mixing[p]
    return e.reshape(len(x), -1)


def wide_images(x: Float64) -> Float64:
    """(n, T * C): each parameter changes everything."""
    images: Float64 = (x - 0.5) @ np.random.default_rng(8).standard_normal((D, T * C))
    return images


def samples(n: int, seed: int = 0) -> Float64:
    return 0.5 + STD * np.random.default_rng(seed).standard_normal((n, D))


def centered(x: Float64, e: Float64) -> tuple[Float64, Float64, Float64]:
    """u, e and w, all candidates counting alike."""
    n = len(x)
    w = np.full(n, 1 / n)
    return (x - x.mean(0)) / STD / np.sqrt(n), (e - e.mean(0)) / np.sqrt(n), w


def test_the_weight_of_a_token_is_its_squared_correlation_beyond_chance() -> None:
    x = samples(200)
    u, e, w = centered(x, local_images(x))
    one = e.reshape(200, T, C)[:, :, :1].reshape(200, T)  # of one channel it is a correlation
    v = token_weights(one, T, u, w)
    share = np.square(np.corrcoef(u.T, one.T)[:D, D:])
    expected = np.maximum(share - screening._CHANCE / 200, 0)
    np.testing.assert_allclose(v, expected / expected.max(axis=1, keepdims=True), atol=1e-9)
    own = np.arange(T) // 3 == np.arange(D)[:, None]
    assert (v[own] > 5 * v[~own].mean()).mean() > 0.8


@pytest.mark.parametrize("weights", ["even", "falling"])
def test_the_predictions_are_those_of_explicit_features(weights: str) -> None:
    """Ridge regression of each parameter on its own weighted features, in the space of features."""
    n, penalty = 25, 0.02
    x = samples(n)
    w = np.full(n, 1.0) if weights == "even" else np.exp(-np.arange(n) / 10)
    w /= w.sum()
    root = np.sqrt(w)[:, None]
    features = local_images(x)
    u, e = ((a - w @ a) * root for a in (x / STD, features))
    none = np.zeros((n, D)), np.full(D, -np.inf)  # so that each takes its own
    local = local_regressions(e, T, u, w, e @ e.T, penalty, 0.0, none)
    assert np.isfinite(local.explained).all()  # each parameter took its own
    probe = local_images(samples(5, seed=1), seed=2) - w @ features
    found = (probe @ e.T) @ local.coefficients + probe @ local.slopes
    v = token_weights(e, T, u, w)
    for p in range(D):
        kept = np.zeros(T)
        strongest = np.argsort(-v[p], kind="stable")[: screening._MOST_TOKENS]
        kept[strongest] = v[p, strongest]
        scaled = np.sqrt(np.repeat(kept + screening._FLOOR, C))
        a = e * scaled
        lam = penalty * np.square(a).sum() / n
        K = np.linalg.solve(a.T @ a + lam * np.eye(T * C), a.T @ u[:, p])
        np.testing.assert_allclose(found[:, p], (probe * scaled) @ K, rtol=0, atol=2e-4)


def proposals_of(images: Float64, x: Float64, target: Float64, screened: bool) -> Float64:
    """The parameters (D,) that the proposer predicts for a target (T * C,), all of the way."""
    proposer = LinearProposer(
        D, capacity=len(x), sources=1, step=(1.0, 1.0), noise=0.0, r2_threshold=0.0,
        select=False, screening=screened,
    )  # fmt: skip
    tokens = torch.as_tensor(images.reshape(len(x), T, C))
    proposer.update(x, tokens, np.arange(len(x), dtype=np.float64), STD)
    wanted = torch.as_tensor(target.reshape(T, C))
    mean = np.full((1, D), 0.5)
    proposed: Float64 = proposer.propose(mean, wanted, mean[0], STD, np.random.default_rng(0))[0]
    return proposed


def test_few_candidates_are_enough_where_each_parameter_shows_in_its_own_place() -> None:
    """Fewer candidates than parameters: the error falls below half; ten scenes."""
    errors = []
    for seed in range(10):
        x = samples(10, seed)
        truth = samples(1, 100 + seed)
        target = local_images(truth, seed)[0]
        found = [proposals_of(local_images(x, seed), x, target, each) for each in (False, True)]
        errors.append([float(np.square(one - truth[0]).mean()) for one in found])
    everywhere, screened = np.mean(errors, axis=0)
    assert screened < 0.5 * everywhere


def pixels(X: Float64) -> Float64:
    """Images (n, 32, 32, 3) of 64 gray squares."""
    images = np.repeat(np.repeat(X.reshape(-1, 8, 8), 4, axis=1), 4, axis=2)
    return np.stack([images] * 3, axis=-1)


def told(generations: int, **options: Any) -> FIDE:
    opt = FIDE(64, pixels(np.random.default_rng(0).random((1, 64)))[0], seed=3, **options)
    for _ in range(generations):
        X = opt.ask()
        opt.tell(X, pixels(X))
    return opt


@pytest.mark.parametrize("wanted", [False, True])
def test_screening_is_for_more_parameters_than_candidates(wanted: bool) -> None:
    options = make_options("balanced", {"screening": wanted})
    for popsize in (D - 1, D):
        made = make_proposer(options, D, popsize, 0, encoders.make("dense"))
        assert isinstance(made, LinearProposer) and made.screening == (wanted and popsize < D)
