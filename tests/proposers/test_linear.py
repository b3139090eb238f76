"""The closed-form proposer, against the same regression done in the space of features."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.types import Float64

D, T, C = 3, 4, 5
STD = np.array([0.05, 0.1, 0.2])
MIXING = np.random.default_rng(1).standard_normal((D, T * C))


def make(**changes: Any) -> LinearProposer:
    options: dict[str, Any] = {
        "capacity": 30, "rank_weight_scale": 0.1, "ridge": 0.2, "sources": 1, "step": (1.0, 1.0),
        "noise": 0.0, "r2_threshold": 0.0,
    }  # fmt: skip
    return LinearProposer(D, **(options | changes))


def propose(
    proposer: LinearProposer,
    target: Tensor,
    m: int = 1,
    *,
    z: Float64 | None = None,
    std: Float64 = STD,
    seed: int = 0,
) -> Float64:
    """Proposals (m, D) from samples z, by default all at the mean 0.5."""
    mean = np.full(D, 0.5)
    z = np.tile(mean, (m, 1)) if z is None else z
    return proposer.propose(z, target, mean, std, np.random.default_rng(seed))


def images_of(x: Float64, bend: float = 0.5) -> Tensor:
    """Tokens (n, T, C): linear in x, and bent."""
    flat = (x - 0.5) @ MIXING
    features = flat + bend * np.sin(3 * flat)
    return torch.as_tensor(features.reshape(len(x), T, C), dtype=torch.float32)


def scene(n: int, seed: int = 0, bend: float = 0.5) -> tuple[Float64, Tensor, Float64]:
    rng = np.random.default_rng(seed)
    x = 0.5 + STD * rng.standard_normal((n, D))
    return x, images_of(x, bend), rng.random(n)


def rank_weights(losses: Float64, elite: float) -> Float64:
    """exp(-rank / (elite n)), summing to 1."""
    w = np.empty(len(losses))
    w[np.argsort(losses, kind="stable")] = np.exp(-np.arange(len(losses)) / (elite * len(losses)))
    weights: Float64 = w / w.sum()
    return weights


class Reference:
    """Weighted ridge regression with explicit features (n, f)."""

    def __init__(self, x: Float64, tokens: Tensor, losses: Float64, p: LinearProposer) -> None:
        n = len(x)
        self.x, self.e = x, tokens.double().numpy().reshape(n, -1)
        w = rank_weights(losses, p.rank_weight_scale)
        u_c = (x / STD - w @ x / STD) * np.sqrt(w)[:, None]
        e_c = (self.e - w @ self.e) * np.sqrt(w)[:, None]
        penalty = p.ridge * np.square(e_c).sum() / min(n, 64)
        self.K = np.linalg.solve(e_c.T @ e_c + penalty * np.eye(e_c.shape[1]), e_c.T @ u_c)

    def step(self, source: int, target: Tensor) -> Float64:
        """The whole way from candidate `source`."""
        wanted = target.double().numpy().reshape(-1)
        step: Float64 = STD * ((wanted - self.e[source]) @ self.K)
        return step


@pytest.mark.parametrize("n", [3, 12, 30, 100])
@pytest.mark.parametrize("pieces", [1, 3])
def test_products_give_the_regression_of_features(n: int, pieces: int) -> None:
    x, tokens, losses = scene(n)
    proposer = make(capacity=n)
    for part in np.array_split(np.arange(n), pieces):
        proposer.update(x[part], tokens[torch.as_tensor(part)], losses[part], STD)
    target = images_of(np.full((1, D), 0.55))[0]
    best = int(np.argmin(losses))
    expected = x[best] + Reference(x, tokens, losses, proposer).step(best, target)
    np.testing.assert_allclose(propose(proposer, target)[0], expected, rtol=0, atol=1e-6)


def test_every_proposal_uses_one_of_the_channel_subsets() -> None:
    """The first three channels alone, or all: two regressions, each used by half of them."""
    x, tokens, losses = scene(30)
    proposer = make(capacity=30, channel_subsets=(3, None))
    proposer.update(x[:13], tokens[:13], losses[:13], STD)
    proposer.update(x[13:], tokens[13:], losses[13:], STD)
    target = images_of(np.full((1, D), 0.55))[0]
    best = int(np.argmin(losses))
    expected = [
        x[best] + Reference(x, seen, losses, proposer).step(best, wanted)
        for seen, wanted in ((tokens[..., :3], target[..., :3]), (tokens, target))
    ]
    proposed = propose(proposer, target, 400)
    distance = [np.abs(proposed - e).max(axis=1) for e in expected]
    assert (np.minimum(*distance) < 1e-6).all()
    assert np.mean(distance[0] < 1e-6) == pytest.approx(0.5, abs=0.1)


def test_all_ordered_pairs_give_the_same_regression() -> None:
    """Differences of all pairs, weighted by w_i w_j: twice the covariances, the same fit."""
    x, tokens, losses = scene(12)
    proposer = make(rank_weight_scale=0.3)
    proposer.update(x, tokens, losses, STD)
    w = rank_weights(losses, 0.3)
    e = tokens.double().numpy().reshape(12, -1)
    root = np.sqrt(np.outer(w, w)).reshape(-1, 1)
    du = root * ((x[:, None] - x[None]) / STD).reshape(-1, D)
    de = root * (e[:, None] - e[None]).reshape(144, -1)
    penalty = proposer.ridge * np.square(de).sum() / 12
    K = np.linalg.solve(de.T @ de + penalty * np.eye(de.shape[1]), de.T @ du)
    target = images_of(np.full((1, D), 0.45))[0]
    best = int(np.argmin(losses))
    wanted = target.double().numpy().reshape(-1)
    expected = x[best] + STD * ((wanted - e[best]) @ K)
    np.testing.assert_allclose(propose(proposer, target)[0], expected, rtol=0, atol=1e-6)


def test_a_random_part_of_the_way_from_one_of_the_best() -> None:
    """Each proposal lies at x_i + a * step_i; i and a are uniform."""
    x, tokens, losses = scene(20)
    proposer = make(sources=3, step=(0.2, 0.6))
    proposer.update(x, tokens, losses, STD)
    target = images_of(np.full((1, D), 0.6))[0]
    reference = Reference(x, tokens, losses, proposer)
    best = np.argsort(losses)[:3]
    steps = np.array([reference.step(int(i), target) for i in best])
    proposals = propose(proposer, target, 3000)
    away = proposals[:, None] - x[best]  # (m, 3, D)
    a = (away * steps).sum(axis=2) / (steps**2).sum(axis=1)
    off = np.linalg.norm(away - a[..., None] * steps, axis=2)
    source = off.argmin(axis=1)
    assert off.min(axis=1).max() < 1e-6
    np.testing.assert_allclose(np.bincount(source, minlength=3) / 3000, 1 / 3, atol=0.05)
    part = a[np.arange(3000), source]
    assert part.min() >= 0.2 - 1e-6 and part.max() <= 0.6 + 1e-6
    assert part.mean() == pytest.approx(0.4, abs=0.01)
    assert part.std() == pytest.approx(0.4 / np.sqrt(12), rel=0.05)


@pytest.mark.parametrize("screening", [False, True])
def test_a_linear_renderer_is_solved_at_once(screening: bool) -> None:
    x, tokens, losses = scene(30, bend=0.0)
    proposer = make(ridge=1e-7, rank_weight_scale=1.0, sources=6, screening=screening)
    proposer.update(x, tokens, losses, STD)
    answer = np.array([0.62, 0.31, 0.9])  # far from what was seen
    target = images_of(answer[None], bend=0.0)[0]
    proposed = propose(proposer, target, 20)
    np.testing.assert_allclose(proposed, np.broadcast_to(answer, (20, D)), atol=1e-4)


def collapsed(what: str) -> tuple[Float64, Tensor, Float64]:
    x, tokens, losses = scene(12)
    if what == "images equal":
        tokens = tokens[:1].repeat(12, 1, 1)
    elif what == "images black":
        tokens = torch.zeros_like(tokens)
    elif what == "parameters equal":
        x = np.repeat(x[:1], 12, axis=0)
    elif what == "everything equal":
        x, tokens = np.repeat(x[:1], 12, axis=0), tokens[:1].repeat(12, 1, 1)
    elif what == "one candidate":
        x, tokens, losses = x[:1], tokens[:1], losses[:1]
    elif what == "two images":
        tokens = tokens[:2].repeat(6, 1, 1)
    elif what == "losses equal":
        losses = np.zeros(12)
    elif what == "losses infinite":
        losses = np.full(12, np.inf)
    elif what == "features nearly equal":
        tokens = 1 + 1e-7 * tokens
    return x, tokens, losses


@pytest.mark.parametrize("screening", [False, True])
def test_proposals_are_samples_where_images_say_nothing(screening: bool) -> None:
    rng = np.random.default_rng(0)
    x, _, losses = scene(30)
    noise = torch.as_tensor(rng.standard_normal((30, T, C)), dtype=torch.float32)
    equal = collapsed("images equal")
    z = 0.5 + STD * rng.standard_normal((8, D))
    for told in ((x, noise, losses), equal):
        proposer = make(r2_threshold=0.05, rank_weight_scale=0.5, sources=5, screening=screening)
        proposer.update(*told, STD)
        proposed = propose(proposer, noise[0] + 1, z=z)
        same = np.isclose(proposed, z, rtol=0, atol=1e-9)
        assert same.mean() > 0.6
        assert same.all() or told is not equal


def test_only_what_images_tell_is_proposed() -> None:
    """The first parameter is in no image: there proposals are samples, in the others none is."""
    x, _, losses = scene(30)
    seen = x.copy()
    seen[:, 0] = 0.5
    proposer = make(r2_threshold=0.05, rank_weight_scale=0.5)
    proposer.update(x, images_of(seen), losses, STD)
    z = 0.5 + STD * np.random.default_rng(1).standard_normal((8, D))
    proposed = propose(proposer, images_of(np.full((1, D), 0.55))[0], z=z)
    np.testing.assert_allclose(proposed[:, 0], z[:, 0], atol=1e-12)
    wholly = make(rank_weight_scale=0.5)
    wholly.update(x, images_of(seen), losses, STD)
    expected = propose(wholly, images_of(np.full((1, D), 0.55))[0], z=z)
    np.testing.assert_allclose(proposed[:, 1:], expected[:, 1:], atol=1e-12)


def test_what_is_explained_is_measured_on_candidates_left_out() -> None:
    """The same regression, fitted again without each candidate in turn."""
    x, tokens, losses = scene(20)
    proposer = make(rank_weight_scale=0.5, ridge=0.02)
    proposer.update(x, tokens, losses, STD)
    view = proposer._buffers[0]
    fit = proposer._regress(view, np.argsort(np.argsort(losses)), STD)
    w, u = rank_weights(losses, 0.5), x / STD
    e = tokens.double().numpy().reshape(len(x), -1)
    e_c = (e - w @ e) * np.sqrt(w)[:, None]
    penalty = 0.02 * np.square(e_c).sum() / len(x)
    residuals = np.empty_like(u)
    for i in range(len(x)):
        left = w * (np.arange(len(x)) != i)
        e_mean, u_mean = (left @ e) / left.sum(), (left @ u) / left.sum()
        a, b = ((v - m) * np.sqrt(left)[:, None] for v, m in ((e, e_mean), (u, u_mean)))
        K = np.linalg.solve(a.T @ a + penalty * np.eye(e.shape[1]), a.T @ b)
        residuals[i] = u[i] - u_mean - (e[i] - e_mean) @ K
    total = w @ np.square(u - w @ u)
    np.testing.assert_allclose(fit.explained, 1 - w @ np.square(residuals) / total, atol=1e-5)
