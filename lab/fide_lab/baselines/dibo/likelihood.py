"""The log-likelihood of the authors' program, which is not that of its diffusion model.

The program means to integrate the probability-flow ODE from a point to noise, as
`Diffusion.log_likelihood` does.  It starts at the noisy end instead, at sigma = 0.63 for 30 steps,
and ends at the clean one, 0.028, where it takes the density of N(0, 0.028^2).  Its times run
backwards as well: 0, at which the network knows the noisiest step, is the clean end here.  One step
of the 3/8 rule makes the whole way, and the divergence is that of x, without the factor of y.

What remains of a likelihood is a strong pull to the mean of the buffer: at 2 standard deviations in
each of 20 parameters, alpha log p is about -5, where the exact one has -0.005 and the reward a
range of some units.  The searches of the authors were made with it.
"""

from __future__ import annotations

from math import log, pi
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from fide_lab.baselines.dibo.diffusion import program_betas

if TYPE_CHECKING:
    from fide_lab.baselines.dibo.diffusion import Predict

__all__ = ["program_likelihood", "program_sigmas"]


def program_sigmas(steps: int) -> Tensor:
    """Noise in the coordinates y of the program's steps + 1 steps, rising, (steps + 1,)."""
    abar = (1 - program_betas(steps).flip(0)).cumprod(0)
    return ((1 - abar) / abar).sqrt()


def program_likelihood(
    predict: Predict, x: Tensor, steps: int, generator: torch.Generator | None = None
) -> Tensor:
    """What the program calls log p(x), (n,), of a model with so many steps.

    Without a generator the divergence is left out; the program takes no gradient of it.
    """
    signs = None
    if generator is not None:
        coin = torch.randint(2, x.shape, generator=generator, device=x.device)
        signs = 2.0 * coin.to(x.dtype) - 1.0
    sigmas = program_sigmas(steps)
    clean, noisy = float(sigmas[0]), float(sigmas[-1])

    def flow(sigma: float, y: Tensor) -> tuple[Tensor, Tensor]:
        t = _time_of(sigma, sigmas)
        return _flow(predict, y * (1 + sigma**2) ** -0.5, x.new_tensor(t).expand(len(x)), signs)

    h = clean - noisy
    k1, g1 = flow(noisy, x)
    k2, g2 = flow(noisy + h / 3, x + h / 3 * k1)
    k3, g3 = flow(noisy + 2 * h / 3, x + h * (k2 - k1 / 3))
    k4, g4 = flow(clean, x + h * (k1 - k2 + k3))
    y = x + h / 8 * (k1 + 3 * (k2 + k3) + k4)
    gained = h / 8 * (g1 + 3 * (g2 + g3) + g4)
    log_normal = -0.5 * (y.square() / clean**2 + log(2 * pi * clean**2)).sum(dim=1)
    out: Tensor = log_normal + gained
    return out


def _flow(predict: Predict, x: Tensor, t: Tensor, signs: Tensor | None) -> tuple[Tensor, Tensor]:
    """Predicted noise (n, d) and its estimated divergence (n,) at x."""
    velocity = predict(x, t)
    if signs is None:
        return velocity, x.new_zeros(len(x))
    with torch.enable_grad():
        point = x.detach().requires_grad_()
        (slope,) = torch.autograd.grad((predict(point, t) * signs).sum(), point)
    return velocity, (slope * signs).sum(dim=1)


def _time_of(sigma: float, sigmas: Tensor) -> float:
    """The program's time: 0 where the noise is least, 1 where it is largest, linear in its log."""
    logs = sigmas.log()
    level = torch.tensor(sigma, dtype=logs.dtype).log().clamp(logs[0], logs[-1])
    above = int(torch.searchsorted(logs, level).clamp(1, len(logs) - 1))
    fraction = float((level - logs[above - 1]) / (logs[above] - logs[above - 1]))
    return (above - 1 + fraction) / (len(sigmas) - 1)
