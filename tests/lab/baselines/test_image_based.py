"""Baselines that learn from features of images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from fide_lab.baselines.image_based import EKI, Inverse, PosteriorSampler, annealed, kalman_update
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32, Float64

Floats = NDArray[np.float64]


def unordered(x: Floats) -> Tensor:
    """Two numbers of which the image shows which are there, not in which order; (n, 1, 2)."""
    return torch.as_tensor(np.sort(x, axis=1), dtype=torch.float32)[:, None]


def trained(n: int = 2400, epochs: int = 9, seed: int = 0) -> PosteriorSampler:
    x = np.random.default_rng(seed).random((n, 2))
    predictor = PosteriorSampler(2, seed=seed, epochs=epochs, batch_size=100, width=24, blocks=2)
    predictor.update(x, unordered(x))
    predictor.update(x, unordered(x), epochs=max(1, epochs // 2), learning_rate=2e-4)
    return predictor


@pytest.mark.thorough
def test_samples_find_both_answers_and_the_regression_their_average() -> None:
    predictor = trained()
    low, high = 0.2, 0.8
    image = unordered(np.array([[low, high]]))[0]
    x = predictor.sample(400, image)
    at = [np.abs(x - answer).max(axis=1) < 0.15 for answer in ([low, high], [high, low])]
    first, second = (float(near.mean()) for near in at)
    assert first + second > 0.8  # a uniform draw: 0.18
    assert 0.3 < first / (first + second) < 0.7  # a fair coin; five standard deviations are 0.13
    regression = predictor.regress(image)
    np.testing.assert_allclose(regression, 0.5, atol=0.1)

    def loss(proposed: Floats) -> Floats:
        wrong = unordered(proposed) - image
        return wrong.square().mean(dim=(1, 2)).double().numpy()

    assert np.median(loss(x)) < 0.05 * loss(regression[None])[0]


def test_samples_lie_in_the_unit_cube_and_repeat_with_the_seed() -> None:
    image = unordered(np.array([[0.0, 1.0]]))[0]
    first, again, other = (trained(200, 1, seed).sample(50, image) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.min() >= 0
    assert first.max() <= 1


def test_the_proposer_is_as_it_was_after_a_training_that_raises_and_after_samples() -> None:
    x = np.random.default_rng(0).random((50, 2))
    predictor = PosteriorSampler(2, epochs=3, width=8, blocks=1)
    proposer = predictor.proposer
    before = proposer.epochs, proposer.learning_rate, proposer.schedule
    predictor.fit(x, unordered(x), epochs=1)
    with pytest.raises(OptionError, match="image tokens keep the shape"):
        predictor.fit(x, torch.zeros(50, 3, 2), epochs=8)
    predictor.sample(5, unordered(x)[0])
    assert (proposer.epochs, proposer.learning_rate, proposer.schedule) == before


ANSWER = np.array([[0.2, 0.7]])


def picture(X: Float64) -> Float32:
    """Two halves, as bright as the parameters say."""
    images: Float32 = np.repeat(X, 8 * 16 * 3, axis=1).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


def test_it_learns_from_uniform_points_and_then_samples_the_answer() -> None:
    network = {"width": 16, "blocks": 1, "epochs": 40, "batch_size": 50}
    options: dict[str, Any] = {"encoder": "patch", "budget": 1000, "share": 0.6, **network}
    opt = Inverse(2, picture(ANSWER)[0], seed=0, **options)
    points = []
    while opt.evaluations < 1000:
        X = opt.ask()
        opt.tell(X, picture(X))
        points.append(X)
    X = np.concatenate(points)
    first, rest = X[:600], X[600:]
    np.testing.assert_allclose(first.mean(axis=0), 0.5, atol=0.05)
    np.testing.assert_allclose(first.std(axis=0), 12**-0.5, atol=0.03)
    np.testing.assert_allclose(np.median(rest, axis=0), ANSWER[0], atol=0.08)
    assert rest.std(axis=0).max() < 0.12
    assert opt.times["train"] > 0.0


def test_the_step_is_the_formula_in_the_space_of_the_features() -> None:
    rng = np.random.default_rng(0)
    x, e, misfit = rng.random((9, 4)), rng.random((9, 20)), rng.random((9, 20))
    c_xe = np.cov(x.T, e.T)[:4, 4:]
    c_ee = np.cov(e.T)
    gain = c_xe @ np.linalg.inv(c_ee + 0.3 * np.eye(20))
    np.testing.assert_allclose(kalman_update(x, e, misfit, 0.3), x + misfit @ gain.T, rtol=1e-9)


def test_on_a_linear_gaussian_problem_it_is_kalmans_posterior() -> None:
    rng = np.random.default_rng(1)
    mean, spread, gamma = np.array([0.2, -1.0, 0.5]), np.array([1.0, 0.5, 2.0]), 0.4
    G, data = rng.standard_normal((5, 3)), rng.standard_normal(5)
    x = mean + spread * rng.standard_normal((20_000, 3))
    updated = kalman_update_in_blocks(x, x @ G.T, data, gamma, rng)
    prior = np.diag(spread**2)
    gain = prior @ G.T @ np.linalg.inv(G @ prior @ G.T + gamma * np.eye(5))
    np.testing.assert_allclose(updated.mean(axis=0), mean + gain @ (data - G @ mean), atol=0.03)
    np.testing.assert_allclose(np.cov(updated.T), (np.eye(3) - gain @ G) @ prior, atol=0.05)


def kalman_update_in_blocks(
    x: Float64, e: Float64, data: Float64, gamma: float, rng: np.random.Generator
) -> Float64:
    """Many ensembles of 200, each updated by itself."""
    parts = [slice(i, i + 200) for i in range(0, len(x), 200)]
    several = [kalman_update(x[p], e[p], data - e[p], gamma, rng) for p in parts]
    return np.concatenate(several)


def test_the_noise_follows_the_data_misfit_controller() -> None:
    """Phi is 2 and 4 for three features, so <Phi> = 3 and Var Phi = 1."""
    misfit = np.array([[2.0, 0.0, 0.0], [2.0, 2.0, 0.0]])
    assert annealed(misfit) == np.sqrt(2 / 3)  # below 2 <Phi> / f = 2
    far_apart = np.array([[0.0, 0.0, 0.0], [0.0, 6.0, 0.0]])  # Phi: 0 and 18
    assert annealed(far_apart) == 6.0  # 2 <Phi> / f, below sqrt(2 * 81 / 3) = 7.3


def test_an_ensemble_without_progress_is_given_up() -> None:
    opt = EKI(3, blobs(np.full((1, 3), 0.3))[0], seed=0, popsize=6, patience=2)
    images = np.full((6, 16, 16, 3), 0.5, np.float32)
    for started in (1, 1, 2):
        opt.tell(opt.ask(), images, np.full(6, 0.5))
        assert opt.starts == started


def blobs(X: Float64) -> Float32:
    waves = np.random.default_rng(3).random((X.shape[1], 16 * 16 * 3))
    images: Float32 = (0.5 + 0.4 * np.sin(X @ waves)).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


def test_a_smooth_problem_is_solved_and_another_ensemble_begins() -> None:
    target = blobs(np.array([[0.3, 0.6, 0.4, 0.7]]))[0]
    opt = EKI(4, target, seed=0, popsize=20)
    while opt.starts == 1:
        X = opt.ask()
        opt.tell(X, blobs(X))
        assert opt.evaluations < 2000
    assert opt.best is not None and opt.best.loss < 1e-6
    assert opt.ask().std() > 0.05
    np.testing.assert_allclose(opt.recommend(), [0.3, 0.6, 0.4, 0.7], atol=1e-2)


def restarted(*then: float) -> EKI:
    """One of which an ensemble that had the loss 0.5 is over; losses of the generations since."""
    opt = EKI(3, blobs(np.full((1, 3), 0.3))[0], seed=0, popsize=6, patience=1)
    images = np.full((6, 16, 16, 3), 0.5, np.float32)
    for loss in (0.5, 0.5, *then):
        opt.tell(opt.ask(), images, np.full(6, loss))
    assert opt.starts == 2
    return opt


def test_it_recommends_the_mean_of_the_best_ensemble() -> None:
    begun, better, worse = restarted(), restarted(0.4), restarted(0.6)
    np.testing.assert_array_equal(better.recommend(), better.ask().mean(axis=0))
    np.testing.assert_array_equal(worse.recommend(), begun.recommend())
    assert not np.array_equal(worse.recommend(), worse.ask().mean(axis=0))
