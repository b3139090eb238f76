"""The closed-form proposer, against the same regression done in the space of features."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.points import Float64
from fide_plugins.proposers.linear import LinearProposer

D, T, C = 3, 4, 5
STD = np.array([0.05, 0.1, 0.2])
MIXING = np.random.default_rng(1).standard_normal((D, T * C))


def make(**changes: Any) -> LinearProposer:
    options: dict[str, Any] = {
        "capacity": 30,
        "elite": 0.1,
        "ridge": 0.2,
        "components": 64,
        "temperature": 0.0,
    }
    return LinearProposer(D, **(options | changes))


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
    """Weighted principal components regression with a ridge, with explicit features (n, f)."""

    def __init__(
        self, x: Float64, tokens: Tensor, losses: Float64, p: LinearProposer, elite: float
    ) -> None:
        self.x, self.e = x, tokens.double().numpy().reshape(len(x), -1)
        w = rank_weights(losses, elite)
        u, e = x / STD, self.e
        u_c = (u - w @ u) * np.sqrt(w)[:, None]
        e_c = (e - w @ e) * np.sqrt(w)[:, None]
        n = len(x)
        _, singular, right = np.linalg.svd(e_c, full_matrices=False)
        energy = np.zeros(n)  # eigenvalues of e_c e_c^T, descending
        energy[: len(singular)] = singular**2
        penalty = p.ridge * energy[: p.components].mean()
        right = right[: p.components]
        covariance = e_c.T @ e_c
        inner = right @ covariance @ right.T + penalty * np.eye(len(right))
        self.K = right.T @ np.linalg.solve(inner, right @ (e_c.T @ u_c))
        self.residuals = (u - w @ u) - (e - w @ e) @ self.K

    def propose(self, sources: Any, target: Tensor) -> Float64:
        wanted = target.double().numpy().reshape(-1)
        proposals: Float64 = self.x[sources] + STD * ((wanted - self.e[sources]) @ self.K)
        return proposals


@pytest.mark.parametrize("n", [3, 12, 30])
@pytest.mark.parametrize("components", [2, 64])
@pytest.mark.parametrize("pieces", [1, 3])
def test_products_give_the_regression_of_features(n: int, components: int, pieces: int) -> None:
    x, tokens, losses = scene(n)
    proposer = make(components=components)
    for part in np.array_split(np.arange(n), pieces):
        proposer.update(x[part], tokens[torch.as_tensor(part)], losses[part], STD)
    target = images_of(np.full((1, D), 0.55))[0]
    m = min(5, n)
    best = np.argsort(losses)[:m]
    proposed = proposer.propose(np.zeros((m, D)), target, STD, np.random.default_rng(0))
    expected = Reference(x, tokens, losses, proposer, proposer.elite).propose(best, target)
    np.testing.assert_allclose(proposed, expected, rtol=0, atol=1e-6)


def test_all_ordered_pairs_give_the_same_regression() -> None:
    """Differences of all pairs, weighted by w_i w_j: twice the covariances, the same fit."""
    x, tokens, losses = scene(12)
    proposer = make(elite=0.3)
    proposer.update(x, tokens, losses, STD)
    w = rank_weights(losses, 0.3)
    e = tokens.double().numpy().reshape(12, -1)
    du = ((x[:, None] - x[None]) / STD).reshape(-1, D)
    de = (e[:, None] - e[None]).reshape(144, -1)
    root = np.sqrt(np.outer(w, w)).reshape(-1, 1)
    centered = (e - w @ e) * np.sqrt(w)[:, None]
    energy = np.linalg.eigvalsh(centered @ centered.T)
    penalty = 2 * proposer.ridge * energy.mean()  # twice, as the covariances
    normal = (root * de).T @ (root * de) + penalty * np.eye(de.shape[1])
    K = np.linalg.solve(normal, (root * de).T @ (root * du))
    target = images_of(np.full((1, D), 0.45))[0]
    best = np.argsort(losses)[:4]
    wanted = target.double().numpy().reshape(-1)
    proposed = proposer.propose(np.zeros((4, D)), target, STD, np.random.default_rng(0))
    expected = x[best] + STD * ((wanted - e[best]) @ K)
    np.testing.assert_allclose(proposed, expected, rtol=0, atol=1e-6)


def test_a_linear_renderer_is_solved_at_once() -> None:
    x, tokens, losses = scene(30, bend=0.0)
    proposer = make(ridge=1e-7, elite=1.0)
    proposer.update(x, tokens, losses, STD)
    answer = np.array([0.62, 0.31, 0.9])  # far from what was seen
    target = images_of(answer[None], bend=0.0)[0]
    proposed = proposer.propose(np.zeros((6, D)), target, STD, np.random.default_rng(0))
    np.testing.assert_allclose(proposed, np.broadcast_to(answer, (6, D)), atol=1e-4)


def test_a_source_that_shows_the_target_stays_where_it_is() -> None:
    x, tokens, losses = scene(20)
    losses[7] = -1.0
    proposer = make()
    proposer.update(x, tokens, losses, STD)
    proposed = proposer.propose(np.zeros((1, D)), tokens[7], STD, np.random.default_rng(0))
    np.testing.assert_allclose(proposed[0], x[7], atol=1e-7)


def test_noise_has_twice_the_covariance_that_the_fit_leaves() -> None:
    """And none along what the image explains."""
    x, tokens, losses = scene(30)
    x[:, 2] = 0.5 + STD[2] * np.random.default_rng(9).standard_normal(30)  # not in the image
    proposer = make(temperature=0.7, ridge=1e-3, elite=0.3)
    proposer.update(x, tokens, losses, STD)
    n = 30 * 400
    target = images_of(np.full((1, D), 0.5))[0]
    rng = np.random.default_rng(0)
    noisy = proposer.propose(np.zeros((n, D)), target, STD, rng)
    proposer.temperature = 0.0
    noise = (noisy - proposer.propose(np.zeros((n, D)), target, STD, rng)) / (0.7 * STD)
    reference = Reference(x, tokens, losses, proposer, proposer.elite)
    w = rank_weights(losses, 2 * proposer.elite)
    r = reference.residuals - w @ reference.residuals
    expected = 2 * (r.T * w) @ r
    np.testing.assert_allclose(np.cov(noise.T), expected, atol=0.06 * np.abs(expected).max())
    assert noise[:, 2].std() > 3 * noise[:, :2].std(axis=0).max()


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


@pytest.mark.parametrize("std", [1e-200, 1e-12, 1.0])
@pytest.mark.parametrize(
    "what",
    [
        "images equal",
        "images black",
        "parameters equal",
        "everything equal",
        "one candidate",
        "two images",
        "losses equal",
        "losses infinite",
        "features nearly equal",
    ],
)
def test_finite_when_the_buffer_has_collapsed(what: str, std: float) -> None:
    x, tokens, losses = collapsed(what)
    proposer = make(temperature=0.5, ridge=1e-9)
    wide = np.full(D, std)
    proposer.update(x, tokens, losses, wide)
    target = images_of(np.full((1, D), 0.7))[0]
    proposed = proposer.propose(np.zeros((20, D)), target, wide, np.random.default_rng(0))
    assert proposed.shape == (20, D)
    assert np.isfinite(proposed).all()
    influence = proposer.influence()
    assert influence is not None and influence.shape == (T, D)
    assert np.isfinite(influence).all() and (influence >= 0).all()


def test_an_image_that_says_nothing_moves_nothing() -> None:
    x, tokens, losses = collapsed("images equal")
    proposer = make()
    proposer.update(x, tokens, losses, STD)
    proposed = proposer.propose(
        np.zeros((12, D)), images_of(np.full((1, D), 0.7))[0], STD, np.random.default_rng(0)
    )
    np.testing.assert_allclose(proposed, x[np.argsort(losses)], atol=1e-6)


def test_the_buffer_holds_the_latest() -> None:
    """Whatever the pieces, also one that is larger than the buffer."""
    x, tokens, losses = scene(50)
    target = images_of(np.full((1, D), 0.6))[0]
    expected = None
    for pieces in ([20], [5] * 4, [1, 25], [50], [48, 2], [3, 45, 2]):
        proposer = make(capacity=20)
        start = 50 - sum(pieces)
        for n in pieces:
            part = slice(start, start + n)
            proposer.update(x[part], tokens[part], losses[part], STD)
            start += n
        proposed = proposer.propose(np.zeros((20, D)), target, STD, np.random.default_rng(0))
        expected = proposed if expected is None else expected
        np.testing.assert_allclose(proposed, expected, atol=1e-8, err_msg=str(pieces))


def test_ready_from_the_stated_minimum_and_not_after_forgetting() -> None:
    x, tokens, losses = scene(10)
    proposer = make(minimum=6)
    assert not proposer.ready
    proposer.update(x[:5], tokens[:5], losses[:5], STD)
    assert not proposer.ready
    proposer.update(x[5:6], tokens[5:6], losses[5:6], STD)
    assert proposer.ready
    proposer.forget()
    assert not proposer.ready
    assert proposer.influence() is None
    fresh = make(minimum=6)
    for p in (proposer, fresh):
        p.update(x, tokens, losses, STD)
    target = tokens[0]
    a, b = (
        p.propose(np.zeros((3, D)), target, STD, np.random.default_rng(0))
        for p in (proposer, fresh)
    )
    np.testing.assert_array_equal(a, b)


def test_influence_is_the_energy_of_the_jacobian() -> None:
    """Each parameter moves its own token: token i by i + 1 for a standard deviation."""
    x = np.random.default_rng(0).standard_normal((400, D)) * STD
    tokens = np.zeros((400, T, 1))
    for i in range(D):
        tokens[:, i, 0] = (i + 1) * x[:, i] / x[:, i].std()
    proposer = make(capacity=400)
    proposer.update(x, torch.as_tensor(tokens), np.zeros(400), STD)
    influence = proposer.influence()
    assert influence is not None
    expected = np.zeros((T, D))
    expected[:D] = np.diag([1.0, 4.0, 9.0])
    np.testing.assert_allclose(influence, expected, rtol=0.05, atol=0.05)


def test_state_goes_on_bit_for_bit() -> None:
    original, copy = make(temperature=0.5), make(temperature=0.5)
    x, tokens, losses = scene(40)
    original.update(x[:25], tokens[:25], losses[:25], STD)
    copy.load_state_dict({key: np.copy(v) for key, v in original.state_dict().items()})
    results = []
    for proposer in (original, copy):
        proposer.update(x[25:], tokens[25:], losses[25:], STD)
        rng = np.random.default_rng(2)
        results.append(proposer.propose(np.zeros((6, D)), tokens[3], STD, rng))
    np.testing.assert_array_equal(results[0], results[1])
    assert original.ready and copy.ready


def test_what_is_given_is_not_changed() -> None:
    x, tokens, losses = scene(12)
    before = x.copy(), tokens.clone(), losses.copy()
    proposer = make()
    proposer.update(x, tokens, losses, STD)
    proposer.propose(np.zeros((3, D)), tokens[0], STD, np.random.default_rng(0))
    np.testing.assert_array_equal(x, before[0])
    assert torch.equal(tokens, before[1])
    np.testing.assert_array_equal(losses, before[2])


def test_every_option_is_documented() -> None:
    documented = inspect.getdoc(LinearProposer) or ""
    for name in inspect.signature(LinearProposer.__init__).parameters:
        assert name == "self" or name in documented
