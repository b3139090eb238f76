"""A head by denoising: the network of `fide_plugins.denoiser`, global.

Parameters are counted in z = Phi^-1(u), in which the prior is N(0, 1), so the `whitened`
preconditioner of mean 0 and standard deviation 1 is exact without an image.  Samples follow the
probability-flow ODE (Karras et al. 2022); the density follows from its exact divergence.  A
periodic axis is cut open at its ends, since the denoiser knows no circles.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from fide_plugins.denoiser import Denoise
from fide_plugins.denoiser.network import Context, ParameterTransformer
from fide_plugins.denoiser.preconditioning import whitened
from fide_plugins.denoiser.training import WhitenedLoss

__all__ = ["Denoised"]

_DRAWS = 2  # of noise, for each picture of a batch
_LEAST, _MOST = 5e-3, 40.0  # noise, in units of the prior
_STEPS = 10  # of the ODE, each of two velocities, even in ln(noise)
_CHUNK = 512
_EDGE = 1e-6


class Denoised(nn.Module):
    """channels, places: of the encoder's map.  periodic: (d,) bool."""

    def __init__(self, channels: int, places: int, periodic: Tensor) -> None:
        super().__init__()
        self.dim = len(periodic)
        generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())))
        self.network = ParameterTransformer(self.dim, places, channels, generator=generator)
        self.objective = WhitenedLoss(log_mean=-1.0)

    def loss(self, places: Tensor, vector: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Objective of the denoiser at u (B, d)."""
        context = [
            (k.repeat_interleave(_DRAWS, 0), v.repeat_interleave(_DRAWS, 0))
            for k, v in self.network.encode_context(places)
        ]
        z = _coordinates(u).repeat_interleave(_DRAWS, 0)
        return self.objective(self._denoise(context), z, torch.ones(self.dim), generator)

    def _denoise(self, context: Context) -> Denoise:
        return whitened(partial(self.network, context=context), 0.0, 1.0)

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """Logarithm of the density (B,)."""
        parts = zip(torch.split(u, _CHUNK), torch.split(places, _CHUNK), strict=True)
        return torch.cat([self._log_prob(some, given) for some, given in parts])

    def _log_prob(self, u: Tensor, places: Tensor) -> Tensor:
        one = len(places) > 1 and bool((places[0] == places[-1]).all())
        denoise = self._denoise(self.network.encode_context(places[:1] if one else places))
        z = start = _coordinates(u)
        total = torch.zeros(len(u))
        times = torch.logspace(*_range(), _STEPS + 1).tolist()
        for now, then in pairwise(times):  # Heun in ln(noise)
            h = torch.tensor(then / now).log()
            v, div = _with_divergence(denoise, z, now)
            v2, div2 = _with_divergence(denoise, z + h * v, then)
            z, total = z + h / 2 * (v + v2), total + h / 2 * (div + div2)
        variance = 1 + _MOST**2
        last = (
            -0.5 * (z.square() / variance).sum(-1) - 0.5 * self.dim * torch.tensor(variance).log()
        )
        return last + total + 0.5 * start.square().sum(-1)

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Draw (n, d)."""
        denoise = self._denoise(self.network.encode_context(places))
        z = (1 + _MOST**2) ** 0.5 * torch.randn(n, self.dim, generator=generator)
        times = torch.logspace(*_range(), _STEPS + 1).flip(0).tolist()
        for now, then in pairwise(times):
            h = torch.tensor(then / now).log()
            v = z - denoise(z, torch.full_like(z, now))
            middle = z + h * v
            z = z + h / 2 * (v + middle - denoise(middle, torch.full_like(z, then)))
        u: Tensor = torch.special.ndtr(z)
        return u


def _with_divergence(denoise: Denoise, z: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Derivative of z by ln(noise) (B, d) and its divergence (B,)."""
    with torch.enable_grad():
        z = z.detach().requires_grad_()
        v = z - denoise(z, torch.full_like(z, noise))
        diagonal = [
            torch.autograd.grad(v[:, i].sum(), z, retain_graph=True)[0][:, i]
            for i in range(z.shape[1])
        ]
    return v.detach(), torch.stack(diagonal).sum(0)


def _coordinates(u: Tensor) -> Tensor:
    z: Tensor = torch.special.ndtri(u.clamp(_EDGE, 1 - _EDGE))
    return z


def _range() -> tuple[float, float]:
    return float(torch.tensor(_LEAST).log10()), float(torch.tensor(_MOST).log10())
