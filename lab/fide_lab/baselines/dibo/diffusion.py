"""Diffusion in T steps: noising, denoising, and two ways to a log-likelihood.

Notation
--------
i = 0 ... T-1   step of denoising, the noisiest first; time t = i / T
beta            variance of the noise of a step, linear in i (`program_betas` or `paper_betas`)
abar            product of (1 - beta) over this step and all cleaner ones
sigma           sqrt((1 - abar) / abar), the noise in the coordinates x / sqrt(abar)
predict(x, t)   the noise epsilon in x, (n, d)

A denoising step is x' ~ N(mean, beta), mean = (x - beta / sqrt(1 - abar) epsilon) / sqrt(1 - beta);
a noising step, its reverse, x ~ N(sqrt(1 - beta) x', beta).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import log, pi

import torch
from torch import Tensor

__all__ = ["Diffusion", "Predict", "paper_betas", "program_betas"]

Predict = Callable[[Tensor, Tensor], Tensor]

FIRST, LAST = 0.02, 1e-4  # variance of the noise of the noisiest and the cleanest step
MOST_SNR = 5.0  # Min-SNR weights (Hang et al. 2023)
ODE_STEPS = 4


def paper_betas(steps: int) -> Tensor:
    """Variances (T,) as the paper says: from 0.02 to 1e-4, the noisiest first."""
    return torch.linspace(FIRST, LAST, steps, dtype=torch.float64)


def program_betas(steps: int) -> Tensor:
    """Variances (T + 1,) of the authors' program; for T = 30 from 0.0207 to 7.6e-4."""
    rank = torch.arange(steps + 1, 0, -1, dtype=torch.float64)
    return (FIRST - LAST) * rank / steps + LAST


class Diffusion:
    """The process of the first `steps` of some variances, without its network.

    betas: (T,) or longer, the noisiest first.  The steps after the first T are noise that every
    point has and that no step takes away, as in the program; none by default (`paper_betas`).
    """

    def __init__(
        self,
        steps: int,
        dtype: torch.dtype,
        device: torch.device | str = "cpu",
        betas: Tensor | None = None,
    ) -> None:
        self.steps = steps
        every = (paper_betas(steps) if betas is None else betas).to(device, dtype)
        self.beta = every[:steps]
        self.abar = (1 - every).flip(0).cumprod(0).flip(0)[:steps]
        self.sigma = ((1 - self.abar) / self.abar).sqrt()
        self._time = torch.arange(steps, device=device).to(dtype) / steps

    def loss(self, predict: Predict, x: Tensor, generator: torch.Generator) -> Tensor:
        """Squared error of the predicted noise at random steps, weighted by min(5 / SNR, 1)."""
        i = torch.randint(self.steps, (len(x),), generator=generator, device=x.device)
        noise = draw_normal(x, generator)
        abar = self.abar[i, None]
        weight = (MOST_SNR * (1 - abar) / abar).clamp(max=1.0)
        error = predict(abar.sqrt() * x + (1 - abar).sqrt() * noise, self._time[i]) - noise
        return (weight * error.square()).mean()

    def mean(self, x: Tensor, noise: Tensor, i: int | Tensor) -> Tensor:
        """Mean of a denoising step from x, whose noise was predicted; i: number, or (n, 1)."""
        beta, abar = self.beta[i], self.abar[i]
        out: Tensor = (x - beta / (1 - abar).sqrt() * noise) / (1 - beta).sqrt()
        return out

    @torch.no_grad()
    def denoise(self, predict: Predict, x: Tensor, generator: torch.Generator) -> Tensor:
        """States (T + 1, n, d) of a chain that starts at noise x (n, d); the last is clean."""
        states = [x]
        for i in range(self.steps):
            noise = predict(x, self._time[i].expand(len(x)))
            x = self.mean(x, noise, i) + self.beta[i].sqrt() * draw_normal(x, generator)
            states.append(x)
        return torch.stack(states)

    @torch.no_grad()
    def noise(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """States (T + 1, n, d) of a chain that ends at clean points x (n, d)."""
        states = [x]
        for beta in self.beta.flip(0):
            x = (1 - beta).sqrt() * x + beta.sqrt() * draw_normal(x, generator)
            states.append(x)
        return torch.stack(states[::-1])

    def log_ratio(self, states: Tensor, predict: Predict, reference: Predict) -> Tensor:
        """Log-likelihood ratio log p(chain) / q(chain), (n,), of two models; gradients for p.

        Both begin with the same standard normal law, and have the same variances.
        """
        before, after = states[:-1].flatten(0, 1), states[1:].flatten(0, 1)  # (T n, d)
        n = states.shape[1]
        i = torch.arange(self.steps, device=states.device).repeat_interleave(n)
        mine = self.mean(before, predict(before, self._time[i]), i[:, None])
        with torch.no_grad():
            other = self.mean(before, reference(before, self._time[i]), i[:, None])
        gain = (after - other).square() - (after - mine).square()
        ratio: Tensor = (gain.sum(dim=1) / (2 * self.beta[i])).view(self.steps, n).sum(dim=0)
        return ratio

    def log_likelihood(
        self, predict: Predict, x: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Log-likelihood log p(x), (n,), by the probability-flow ODE, RK4 with 4 steps.

        In the coordinates y = x / sqrt(abar) the ODE is dy/dsigma = epsilon, and log p gains its
        divergence, estimated with one random sign for each coordinate (Hutchinson); without a
        generator that part, a constant for a fixed law of the signs, is left out.  Gradients flow
        through y only.
        """
        signs = None
        if generator is not None:
            coin = torch.randint(2, x.shape, generator=generator, device=x.device)
            signs = 2.0 * coin.to(x.dtype) - 1.0
        y, gained = x, x.new_zeros(len(x))
        low, high = float(self.sigma[-1]), float(self.sigma[0])
        grid = [low + (high - low) * k / ODE_STEPS for k in range(ODE_STEPS + 1)]
        for here, there in pairwise(grid):
            y, gained = self._runge_kutta(predict, y, gained, here, there, signs)
        variance = 1 + high**2  # of y there, for x is standard normal
        log_normal = -0.5 * (y.square() / variance + log(2 * pi * variance)).sum(dim=1)
        return log_normal + gained

    def _runge_kutta(
        self, predict: Predict, y: Tensor, gained: Tensor, a: float, b: float, signs: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        h = b - a
        k1, g1 = self._flow(predict, y, a, signs)
        k2, g2 = self._flow(predict, y + h / 2 * k1, a + h / 2, signs)
        k3, g3 = self._flow(predict, y + h / 2 * k2, a + h / 2, signs)
        k4, g4 = self._flow(predict, y + h * k3, b, signs)
        step = h / 6
        return y + step * (k1 + 2 * k2 + 2 * k3 + k4), gained + step * (g1 + 2 * g2 + 2 * g3 + g4)

    def _flow(
        self, predict: Predict, y: Tensor, sigma: float, signs: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Velocity (n, d) and estimated divergence (n,) at noise sigma."""
        shrink = (1 + sigma**2) ** -0.5  # x = y sqrt(abar)
        t = self._time_of(sigma).expand(len(y))
        velocity = predict(y * shrink, t)
        if signs is None:
            return velocity, y.new_zeros(len(y))
        with torch.enable_grad():
            point = (y * shrink).detach().requires_grad_()
            (slope,) = torch.autograd.grad((predict(point, t) * signs).sum(), point)
        return velocity, shrink * (slope * signs).sum(dim=1)

    def _time_of(self, sigma: float) -> Tensor:
        """Time at which the noise is sigma, linear in its logarithm between the steps."""
        logs = self.sigma.log().flip(0)  # rising
        level = self.sigma.new_tensor(sigma).log().clamp(logs[0], logs[-1])
        above = int(torch.searchsorted(logs, level).clamp(1, self.steps - 1))
        fraction = (level - logs[above - 1]) / (logs[above] - logs[above - 1])
        return (self.steps - 1 - (above - 1 + fraction)) / self.steps


def draw_normal(like: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normal numbers of the shape of `like`."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)
