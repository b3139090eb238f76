"""The linear model around a solution, and its covariance, on renderers known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.types import Float64
from fide_plugins.uncertainty import FitToTarget, LocalFit, covariance, fit_locally
from fide_plugins.uncertainty.local_fit import WIDER

D, F, N = 6, 300, 400
MIXING = np.random.default_rng(1).normal(size=(D, F))
HERE = np.full(D, 0.4)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def fitted(
    rng: np.random.Generator, *, noise: float = 0.0, mixing: Float64 = MIXING, width: float = 0.3
) -> LocalFit:
    """At HERE, from images that are linear in the parameters."""
    u = rng.uniform(-width, width, size=(N, D))
    e = (HERE + u) @ mixing + noise * rng.normal(size=(N, F))
    return fit_locally(u, e, np.square(e - HERE @ mixing).sum(axis=1))


def test_a_linear_renderer_is_found_exactly(rng: np.random.Generator) -> None:
    fit = fitted(rng)
    np.testing.assert_allclose(fit.J, MIXING, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(fit.here, HERE @ MIXING, atol=1e-3)


def test_the_covariance_is_that_of_least_squares(rng: np.random.Generator) -> None:
    """Of a target with noise, at the parameters that fit it best: sigma^2 (J J^T)^-1."""
    fit, sigma = fitted(rng), 0.05
    exact = np.sqrt(np.diag(sigma**2 * np.linalg.inv(MIXING @ MIXING.T)))
    noise = sigma * rng.normal(size=F)
    explained = np.linalg.lstsq(MIXING.T, noise, rcond=None)[0]  # of a search that is not over
    target = HERE @ MIXING + noise - explained @ MIXING
    found = np.sqrt(np.diag(covariance(FitToTarget(fit, target, F))))
    sample = np.sqrt(np.square(noise - explained @ MIXING).mean()) / sigma  # of this noise
    np.testing.assert_allclose(found, sample * exact, rtol=0.03)


def test_a_search_that_has_converged_knows_no_more_than_the_noise_of_the_target_says(
    rng: np.random.Generator,
) -> None:
    """Clean renders: the samples lie together, and the truth is as far away as ever."""
    sigma = 0.05
    exact = np.sqrt(np.diag(sigma**2 * np.linalg.inv(MIXING @ MIXING.T)))
    noise = sigma * rng.normal(size=F)
    left = noise - np.linalg.lstsq(MIXING.T, noise, rcond=None)[0] @ MIXING
    sample = np.sqrt(np.square(left).mean()) / sigma  # of this noise
    for last in (1e-2, 1e-4, 1e-6):
        u = np.geomspace(0.3, last, N)[:, None] * rng.uniform(-1, 1, size=(N, D))
        e = (HERE + u) @ MIXING
        fit = fit_locally(u, e, np.square(e - HERE @ MIXING).sum(axis=1))
        found = np.sqrt(np.diag(covariance(FitToTarget(fit, HERE @ MIXING + left, F))))
        np.testing.assert_allclose(found, sample * exact, rtol=0.03)


def test_noise_of_the_renders_is_not_taken_for_knowledge(rng: np.random.Generator) -> None:
    """A parameter without effect: its column of the Jacobian is noise, and nothing else."""
    blind = MIXING.copy()
    blind[2] = 0.0
    for noise in (0.0, 0.5):
        fit = fitted(rng, noise=noise, mixing=blind)
        target = HERE @ blind + 0.05 * rng.normal(size=F)
        std = np.sqrt(np.diag(covariance(FitToTarget(fit, target, F))))
        reach = WIDER**2 * fit.cloud[2, 2]  # of samples that look alike
        assert std[2] == pytest.approx((12 + 1 / reach) ** -0.5, rel=0.1)
        assert 0.2 < std[2] < 12**-0.5
        assert np.delete(std, 2).max() < 0.03


def test_the_error_of_an_unfinished_search_counts(rng: np.random.Generator) -> None:
    """The farther the target is from what is rendered here, the wider the interval."""
    fit = fitted(rng)
    away = rng.normal(size=D)
    away /= np.linalg.norm(away)
    stds = []
    for length in (0.01, 0.02, 0.04):
        target = (HERE + length * away) @ MIXING
        stds.append(np.sqrt(np.diag(covariance(FitToTarget(fit, target, F)))))
        z = np.abs(length * away / stds[-1])
        assert 0.4 < np.sqrt(np.square(z).mean()) < 2.0
    np.testing.assert_allclose(stds[1], 2 * stds[0], rtol=0.05)
    np.testing.assert_allclose(stds[2], 4 * stds[0], rtol=0.1)


def test_intervals_hold_the_truth_as_often_as_they_say(rng: np.random.Generator) -> None:
    """Of least squares fits to noisy targets with noisy renders: 90 %, give or take chance."""
    inside = []
    for _ in range(60):
        fit = fitted(rng, noise=0.1)
        clean = HERE @ MIXING
        noisy = clean + 0.1 * rng.normal(size=F)
        wrong = np.linalg.lstsq(MIXING.T, noisy - clean, rcond=None)[0]  # the minimum, less HERE
        std = np.sqrt(np.diag(covariance(FitToTarget(fit, noisy - wrong @ MIXING, F))))
        inside.append(np.abs(wrong) <= 1.645 * std)
    assert 0.84 < np.mean(inside) < 0.96  # five standard errors of 360


def test_a_step_along_which_nothing_changes_is_unseen_however_short(
    rng: np.random.Generator,
) -> None:
    """A search that has converged, in all parameters alike; curvature is its only error."""
    blind = MIXING.copy()
    blind[2] = 0.0
    u = np.geomspace(0.3, 1e-6, N)[:, None] * rng.uniform(-1, 1, size=(N, D))
    e = (HERE + u) @ blind + np.square(u) @ np.abs(blind)
    distances = np.square(e - HERE @ blind).sum(axis=1)
    fit = fit_locally(u, e, distances)
    model = FitToTarget(fit, HERE @ blind, F, float(distances.max()))
    std = np.sqrt(np.diag(covariance(model)))
    assert std[2] == pytest.approx(12**-0.5, rel=1e-3)
    assert np.delete(std, 2).max() < 1e-3


def test_a_parameter_with_a_small_effect_is_seen(rng: np.random.Generator) -> None:
    small = MIXING.copy()
    small[2] *= 1e-3
    u = np.geomspace(0.3, 1e-4, N)[:, None] * rng.uniform(-1, 1, size=(N, D))
    e = (HERE + u) @ small + 1e-7 * rng.normal(size=(N, F))
    distances = np.square(e - HERE @ small).sum(axis=1)
    fit = fit_locally(u, e, distances)
    target = HERE @ small + 1e-5 * rng.normal(size=F)
    assert covariance(FitToTarget(fit, target, F, float(distances.max())))[2, 2] < 0.01**2
