"""DiBO: diffusion against normal laws, trajectory balance, proxies, rounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.dibo import (
    Diffusion,
    Round,
    RoundOptions,
    program_likelihood,
    trajectory_balance,
)

DOUBLE = torch.float64


def log_normal(x: Tensor, mean: Tensor | float, std: Tensor | float) -> Tensor:
    """Log-density of independent normal laws."""
    law = torch.distributions.Normal(mean, std)
    density: Tensor = law.log_prob(x)  # type: ignore[no-untyped-call]
    return density


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class NormalData:
    """The exact noise predictor for data from N(0, variance) in each coordinate."""

    def __init__(self, diffusion: Diffusion, variance: float) -> None:
        self.diffusion, self.variance = diffusion, variance

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        position = t * self.diffusion.steps  # between steps, ln sigma is linear
        i = position.floor().long().clamp(max=self.diffusion.steps - 2)
        abar = self.diffusion.abar
        logs = ((1 - abar) / abar).log() / 2
        sigma = (logs[i] + (position - i) * (logs[i + 1] - logs[i])).exp()
        abar = (1 / (1 + sigma**2))[:, None]
        return (1 - abar).sqrt() * x / (abar * self.variance + 1 - abar)


def test_the_schedule_leaves_its_cleanest_noise() -> None:
    diffusion = Diffusion(30, DOUBLE)
    ends = torch.tensor([0.0199 * 31 / 30 + 1e-4, 0.0199 * 2 / 30 + 1e-4], dtype=DOUBLE)
    torch.testing.assert_close(diffusion.beta[[0, -1]], ends)
    cleanest = 0.0199 / 30 + 1e-4  # of the program's 31 variances; no step takes it away
    torch.testing.assert_close(diffusion.abar[-1], (1 - ends[1]) * (1 - cleanest))


def test_noising_keeps_a_standard_normal_law_and_denoising_too() -> None:
    diffusion = Diffusion(30, DOUBLE)
    x = torch.randn(20_000, 2, generator=seeded(), dtype=DOUBLE)
    noised = diffusion.noise(x, seeded(1))
    assert noised.shape == (31, 20_000, 2) and torch.equal(noised[-1], x)
    assert abs(noised[0].std() - 1) < 0.02
    kept = (noised[0] * x).mean()
    torch.testing.assert_close(kept, (1 - diffusion.beta).prod().sqrt(), atol=0.02, rtol=0.0)
    chains = diffusion.denoise(NormalData(diffusion, 1.0), x, seeded(2))
    assert torch.equal(chains[0], x) and abs(chains[-1].std() - 1) < 0.02


def test_the_likelihood_of_the_program_is_its_odes_the_other_way_round() -> None:
    """Of a linear model: one step of fourth order is its Taylor series, to that order."""
    clean, noisy = 0.027639038627, 0.630229672440

    def linear(x: Tensor, t: Tensor) -> Tensor:  # the flow is then -0.4 y / sqrt(1 + sigma^2)
        return -0.4 * x

    x = torch.randn(50, 3, generator=seeded(), dtype=DOUBLE)
    found = program_likelihood(linear, x, 30, seeded(1))
    along = float(np.arcsinh(clean) - np.arcsinh(noisy))
    at_the_end = log_normal(x * np.exp(-0.4 * along), 0.0, clean).sum(dim=1)
    gained = -0.4 * (clean - noisy) * 3  # of x, without the factor of y
    torch.testing.assert_close(found, at_the_end + gained, rtol=1e-4, atol=0.0)
    without = program_likelihood(linear, x, 30)
    torch.testing.assert_close(found - without, torch.full_like(x[:, 0], gained))


def test_the_ratio_of_chains_is_that_of_their_transition_laws() -> None:
    diffusion = Diffusion(5, DOUBLE)
    p, q = NormalData(diffusion, 1.0), NormalData(diffusion, 0.2)
    states = diffusion.noise(torch.randn(7, 2, generator=seeded(), dtype=DOUBLE), seeded(1))
    expected = torch.zeros(7, dtype=DOUBLE)
    for i in range(5):
        t = torch.full((7,), i / 5, dtype=DOUBLE)
        for predict, sign in ((p, 1), (q, -1)):
            mean = diffusion.mean(states[i], predict(states[i], t), i)
            std = diffusion.beta[i].sqrt()
            expected += sign * log_normal(states[i + 1], mean, std).sum(dim=1)
    torch.testing.assert_close(diffusion.log_ratio(states, p, q), expected)
    torch.testing.assert_close(diffusion.log_ratio(states, q, q), torch.zeros(7, dtype=DOUBLE))


def test_trajectory_balance_is_zero_at_its_optimum_and_only_there() -> None:
    ratio = torch.randn(9, generator=seeded(), dtype=DOUBLE)
    log_z = torch.tensor(0.7, dtype=DOUBLE, requires_grad=True)
    reward = 0.7 + 0.1 * ratio
    loss = trajectory_balance(log_z, ratio, reward, alpha=0.1)
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.item() < 1e-30 and log_z.grad is not None and abs(log_z.grad) < 1e-15
    off = trajectory_balance(log_z, ratio, reward + 2.0, alpha=0.1)
    torch.testing.assert_close(off, torch.tensor(2.0, dtype=DOUBLE))


def small_round(**changes: Any) -> Round:
    """A buffer of points around 0 whose value falls from (0.8, 0.8)."""
    x = torch.randn(120, 2, generator=seeded(), dtype=DOUBLE)
    y = -(x - 0.8).square().sum(dim=1)
    small = {"width": 16, "proxy_width": 32, "diffusion_steps": 6, "batch": 32, "proposals": 2}
    epochs = {"proxy_epochs": 25, "prior_epochs": 10, "posterior_epochs": 3, "search_epochs": 20}
    options = RoundOptions(**{**small, **epochs, **changes})
    return Round(options, (x - x.mean(0)) / x.std(0), (y - y.mean()) / y.std(), seeded(3))


def test_a_round_proposes_near_the_best_of_its_buffer() -> None:
    round_ = small_round()
    found = round_.candidates(10)
    assert found.shape == (10, 2)
    best = round_.x[round_.y.argmax()]
    distance = (found - best).norm(dim=1).median()
    assert distance < 0.6 * (round_.x - best).norm(dim=1).median()
    scores = round_._score(found)
    assert scores.min() > round_._score(round_.x).median()


def test_the_prior_is_frozen_while_the_posterior_learns() -> None:
    round_ = small_round(posterior_epochs=3)
    before = {k: v.clone() for k, v in round_.prior.state_dict().items()}
    posterior = round_.posterior
    assert all(torch.equal(v, before[k]) for k, v in round_.prior.state_dict().items())
    t = torch.zeros(4, dtype=DOUBLE)
    x = torch.rand(4, 2, generator=seeded(), dtype=DOUBLE)
    doubled = 2 * round_.prior(x, t)  # where it began: the prior and a copy of it
    assert not torch.equal(posterior(x, t), doubled)
    torch.testing.assert_close(posterior(x, t), doubled, atol=0.3, rtol=0.3)
    assert torch.equal(small_round(posterior_epochs=0).posterior(x, t), doubled)
