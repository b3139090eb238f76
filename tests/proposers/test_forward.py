"""The forward model, against the same regressions done in the space of features."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.proposers import forward
from fide_plugins.proposers.forward import GaussNewtonSteps, Jacobian, fit_jacobian
from fide_plugins.types import Float64

D, T, C = 4, 5, 3
STD = np.array([0.05, 0.1, 0.2, 0.1])
MIXING = np.random.default_rng(1).standard_normal((D, T * C))
ANSWER = np.array([0.3, 0.6, 0.45, 0.7])


@pytest.fixture
def nothing_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps alone, without the part of a sample that tells proposals apart."""
    monkeypatch.setattr(forward, "_LEAST_KEPT", 0.0)


def make(dim: int = D, **changes: Any) -> GaussNewtonSteps:
    options: dict[str, Any] = {"damping": (1e-9, 1e-9), "ridge": (1e-9, 1e-9), "kept": 0.0}
    return GaussNewtonSteps(dim, **(options | changes))


def balanced(proposer: GaussNewtonSteps, jacobian: Jacobian, slope: Float64) -> float:
    """The unit of the damping."""
    return float(proposer._damped(jacobian, slope, np.ones((1, 1)))[1][0, 0])


def images_of(x: Float64, bend: float = 0.0) -> Tensor:
    """Tokens (n, T, C), linear in x and bent."""
    flat = (x - 0.5) @ MIXING[: x.shape[1]]
    return torch.as_tensor((flat + bend * flat**2).reshape(len(x), T, C))


def scene(n: int, seed: int = 0, bend: float = 0.0) -> tuple[Float64, Tensor, Float64]:
    """Candidates, their tokens, and losses, for the target of ANSWER."""
    x = np.random.default_rng(seed).normal(0.5, STD, (n, D))
    tokens = images_of(x, bend)
    wrong = tokens - images_of(ANSWER[None], bend)
    return x, tokens, wrong.square().mean(dim=(1, 2)).numpy()


def step(
    proposer: GaussNewtonSteps, target: Tensor, m: int = 1, std: Float64 = STD, seed: int = 0
) -> Float64:
    mean = np.full(proposer.dim, 0.5)
    rng = np.random.default_rng(seed)
    z = rng.normal(mean, std, (m, proposer.dim))
    return proposer.propose(z, target, mean, std, rng)


@pytest.mark.parametrize("n", [D + 1, 12, 36])
def test_of_a_linear_renderer_one_step_lands_on_the_answer(n: int) -> None:
    proposer = make(longest=10.0)
    proposer.update(*scene(n), STD)
    np.testing.assert_allclose(step(proposer, images_of(ANSWER[None])[0])[0], ANSWER, atol=1e-5)


def direct_jacobian(u: Float64, e: Float64, ridge: tuple[float, float]) -> Float64:
    """Both regressions as the module says them, (d, f)."""

    def solve(a: Float64, b: Float64, w: Float64, penalty: float) -> Float64:
        normal = (a.T * w) @ a
        p = penalty * np.trace(normal) / len(normal)
        J: Float64 = np.linalg.solve(normal + p * np.eye(len(normal)), (a.T * w) @ b)
        return J

    squared = (u**2).sum(axis=1)
    wide = solve(u, e, 1 / (squared + np.median(squared)), ridge[0])
    near = np.argsort(squared)[1 : 2 * u.shape[1] + 1]  # the first is the best itself
    distances = np.sqrt(squared[near])[:, None]
    rest = (e - u @ wide)[near] / distances
    return wide + solve(u[near] / distances, rest, np.ones(len(near)), ridge[1])


@pytest.mark.usefixtures("nothing_kept")
@pytest.mark.parametrize("n", [3, 7, 40])
@pytest.mark.parametrize("ridge", [(1e-2, 1e-2), (1.0, 0.1)])
def test_scalar_products_give_what_features_give(n: int, ridge: tuple[float, float]) -> None:
    x, tokens, losses = scene(n, bend=0.7)
    b = int(np.argmin(losses))
    u, flat = (x - x[b]) / STD, tokens.reshape(n, -1).numpy()
    around = flat - flat.mean(axis=0)  # any origin does
    jacobian = fit_jacobian(u, around @ around.T, b, ridge)
    J = direct_jacobian(u, flat - flat[b], ridge)
    np.testing.assert_allclose(jacobian.Q @ (flat - flat[b]), J, atol=1e-10)
    values = np.linalg.eigvalsh(J @ J.T)
    np.testing.assert_allclose(jacobian.values, np.maximum(values, 0), atol=1e-9 * values[-1])
    missing = (images_of(ANSWER[None], 0.7)[0].reshape(-1)).numpy() - flat[b]
    proposer = make(capacity=50, ridge=ridge, damping=(0.3, 0.3), longest=1e9)
    unit = balanced(proposer, jacobian, jacobian.vectors.T @ J @ missing)
    proposer.update(x, tokens, losses, STD)
    expected = x[b] + STD * np.linalg.solve(J @ J.T + 0.3 * unit * np.eye(D), J @ missing)
    made = step(proposer, images_of(ANSWER[None], 0.7)[0])
    np.testing.assert_allclose(made[0], expected, atol=1e-8)


def test_without_penalty_the_jacobian_is_that_of_least_squares() -> None:
    x, tokens, losses = scene(30)
    b = int(np.argmin(losses))
    u, e = (x - x[b]) / STD, (tokens - tokens[b]).reshape(30, -1).numpy()
    jacobian = fit_jacobian(u, e @ e.T, b, (0.0, 0.0))
    np.testing.assert_allclose(jacobian.Q @ e, np.linalg.lstsq(u, e, rcond=None)[0], atol=1e-9)


def test_the_nearest_candidates_tell_the_slope_at_the_best() -> None:
    """Of a bent renderer: without them the slope is an average over all candidates."""
    proposer = make(ridge=(1e-4, 1e-4), longest=10.0)
    proposer.update(*scene(36, bend=1.0), STD)
    target = images_of(ANSWER[None], 1.0)[0]
    errors = []
    for _ in range(8):
        x = step(proposer, target)
        errors.append(np.abs(x - ANSWER).max())
        loss = (images_of(x, 1.0) - target).square().mean(dim=(1, 2)).numpy()
        proposer.update(x, images_of(x, 1.0), loss, STD)
    assert errors[-1] < 3e-5 * errors[0]


@pytest.mark.parametrize("n", [3, 7, 40])
def test_the_curvature_is_what_the_model_misses_of_its_neighbors(n: int) -> None:
    """Residuals over one minus leverages, which is what leaving one out gives."""
    x, tokens, losses = scene(n, bend=0.7)
    b = int(np.argmin(losses))
    u, e = (x - x[b]) / STD, (tokens - tokens[b]).reshape(n, -1).numpy()
    J = direct_jacobian(u, e, (1e-2, 1e-2))
    squared = (u**2).sum(axis=1)
    near = np.argsort(squared)[1 : 2 * D + 1]
    a = u[near] / np.sqrt(squared[near])[:, None]
    p = 1e-2 * np.trace(a.T @ a) / D
    leverages = np.diag(a @ np.linalg.solve(a.T @ a + p * np.eye(D), a.T))
    missed = (e - u @ J)[near] / (1 - leverages)[:, None]
    c = np.square(missed).sum() / np.square(squared[near]).sum()
    assert fit_jacobian(u, e @ e.T, b, (1e-2, 1e-2)).curvature == pytest.approx(c, rel=1e-6)


@pytest.mark.parametrize("bend", [0.1, 1.0, 10.0])
def test_the_damping_balances_what_is_gained_and_what_the_model_misses(bend: float) -> None:
    """No other step of the family lowers |e* - delta J|^2 + c |delta|^4 by much more."""
    x, tokens, losses = scene(40, bend=bend)
    proposer = make(capacity=40, ridge=(1e-2, 1e-2))
    proposer.update(x, tokens, losses, STD)
    _, jacobian, slope = proposer._model(images_of(ANSWER[None], bend)[0], STD)

    def objective(damping: float) -> float:
        delta = slope / (jacobian.values + damping)
        quadratic = delta @ (jacobian.values * delta) - 2 * delta @ slope
        return float(quadratic + jacobian.curvature * (delta @ delta) ** 2)

    chosen = objective(balanced(proposer, jacobian, slope))
    best = min(objective(damping) for damping in np.logspace(-8, 4, 400) * jacobian.values.mean())
    assert best - 1e-3 * abs(best) <= chosen <= 0.9 * best < 0  # on a grid
    for curvature, limit in ((0.0, 1e-10), (1e99, 1e2)):
        odd = jacobian._replace(curvature=curvature, rounding=0.0)
        assert balanced(proposer, odd, slope) == pytest.approx(limit * odd.values.mean())


@pytest.mark.usefixtures("nothing_kept")
def test_damping_is_log_uniform_and_steps_are_cut() -> None:
    x, tokens, losses = scene(40, bend=1.0)
    target = images_of(ANSWER[None], 1.0)[0]
    proposer = make(damping=(1e-2, 10.0), ridge=(1e-2, 1e-2), longest=100.0)
    proposer.update(x, tokens, losses, STD)
    _, jacobian, slope = proposer._model(target, STD)
    best = x[np.argmin(losses)]
    steps = ((step(proposer, target, 2000) - best) / STD) @ jacobian.vectors
    dampings = slope[0] / steps[:, 0] - jacobian.values[0]
    logs = np.sort(np.log10(dampings / balanced(proposer, jacobian, slope)))
    np.testing.assert_allclose(logs, np.linspace(-2, 1, 2000), atol=0.15)
    short = make(longest=1e-3)
    short.update(x, tokens, losses, STD)
    lengths = np.linalg.norm((step(short, target, 3) - best) / STD, axis=1)
    np.testing.assert_allclose(lengths, 1e-3 * np.sqrt(D))


def test_a_model_that_explains_nothing_gives_samples_back() -> None:
    """Of images that never change."""
    x, tokens, losses = scene(20)
    proposer = GaussNewtonSteps(D)
    proposer.update(x, tokens[:1].expand(20, T, C), losses, STD)
    rng = np.random.default_rng(1)
    z = rng.normal(0.5, STD, (50, D))
    made = proposer.propose(z, images_of(ANSWER[None])[0], np.full(D, 0.5), STD, rng)
    np.testing.assert_allclose(made, z, atol=1e-9)


def test_a_model_that_is_right_keeps_nothing_of_samples() -> None:
    x, tokens, losses = scene(40)
    proposer = GaussNewtonSteps(D, ridge=(1e-6, 1e-6), longest=10.0)
    proposer.update(x, tokens, losses, STD)
    made = step(proposer, images_of(ANSWER[None])[0], 50)
    np.testing.assert_allclose(made, np.tile(ANSWER, (50, 1)), atol=1e-3)


def test_the_better_half_and_the_latest_half_are_remembered() -> None:
    x, tokens, losses = scene(40)
    proposer = make(capacity=10)
    for part in np.array_split(np.arange(40), 20):
        proposer.update(x[part], tokens[torch.from_numpy(part)], losses[part], STD)
    kept = [int(np.flatnonzero((x == row).all(axis=1))[0]) for row in proposer.x]
    best = np.argsort(losses[:35])[:5]
    assert kept == [*sorted(best), 35, 36, 37, 38, 39]
    np.testing.assert_array_equal(proposer._losses, losses[kept])
    features = proposer._buffer.features
    np.testing.assert_allclose(proposer._buffer.gram, features @ features.T, atol=1e-12)
    both = make(capacity=10)
    both.update(x, tokens, losses, STD)
    assert sorted(map(tuple, both.x)) == sorted(map(tuple, proposer.x))
