"""Densities on one axis of the unit cube: mixtures of truncated, or of wrapped, Gaussians.

    ordinary axis    sum_k w_k N(u; m_k, s_k) / (Phi((1 - m_k) / s_k) - Phi(-m_k / s_k))
    periodic axis    sum_k w_k sum_j N(u + j; m_k, s_k),  j = -1, 0, 1

Both have all their mass in [0, 1], and a wide component is nearly uniform there.  A network gives
four numbers for each component: the weight, two for the mean (on a circle the direction of a
vector, so that both ends are neighbors), and the logarithm of the standard deviation.  An integer
or a choice needs nothing of its own: its cells are uniform in the cube, and so is its posterior
within a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["NUMBERS", "Components", "fourier", "frequencies"]

NUMBERS = 4
"""That a network gives for each component."""

_SMALLEST, _LARGEST, _LARGEST_PERIODIC = 2e-3, 1.0, 0.5  # standard deviations
_OFFSET = 1.0  # so that a network that says 0 means about 0.2
_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Components:
    """Gaussians (..., d, K) of each of d axes.

    weight: their logarithms, normalized over K only where `of` is told so.
    mean, std: in units of the cube.  periodic: (d, 1), axes that wrap around.
    """

    weight: Tensor
    mean: Tensor
    std: Tensor
    periodic: Tensor

    @classmethod
    def of(cls, raw: Tensor, periodic: Tensor, *, normalize: bool = True) -> Components:
        """Components of a network's numbers (..., d, K, 4).

        periodic: (d,) bool.  normalize: whether the K of each axis are a mixture by themselves.
        """
        weight, first, second, scale = raw.unbind(-1)
        wraps = periodic[:, None]
        angle = torch.atan2(second, first + 1e-6) / (2 * math.pi)
        mean = torch.where(wraps, angle - angle.floor(), torch.sigmoid(first))
        largest = _largest(wraps)  # (d, 1)
        std = _SMALLEST * (largest / _SMALLEST) ** torch.sigmoid(scale + _OFFSET)
        if normalize:
            weight = F.log_softmax(weight, dim=-1)
        return cls(weight, mean, std, wraps)

    def widened(self, scale: float) -> Components:
        """Return the same with standard deviations times `scale`, see `judging.calibration`."""
        if scale == 1.0:
            return self
        largest = _largest(self.periodic)
        std = torch.minimum(self.std * scale, largest)  # what wraps stays within three turns
        return Components(self.weight, self.mean, std, self.periodic)

    def log_density(self, u: Tensor) -> Tensor:
        """Logarithm of each component's density (..., d, K), without its weight, at u (..., d)."""
        z = (u[..., None] - self.mean) / self.std
        peak = -self.std.log() - 0.5 * math.log(2 * math.pi)
        straight = peak - 0.5 * z.square() - self._mass().log()
        on_cpu = self.periodic.device.type == "cpu"  # a GPU would be waited for
        if on_cpu and not bool(self.periodic.any()):
            return straight
        around = torch.stack([(z + j / self.std).square() for j in (-1.0, 0.0, 1.0)])
        wrapped = peak + torch.logsumexp(-0.5 * around, dim=0)
        return torch.where(self.periodic, wrapped, straight)

    def log_mixture(self, u: Tensor) -> Tensor:
        """Logarithm of the density of each axis (..., d) at u (..., d)."""
        return torch.logsumexp(self.weight + self.log_density(u), dim=-1)

    def draw(self, which: Tensor, generator: torch.Generator) -> Tensor:
        """Draw (..., d) from the component `which` (..., d) of each axis."""
        mean, std = (t.gather(-1, which[..., None])[..., 0] for t in (self.mean, self.std))
        low, high = _phi(-mean / std), _phi((1 - mean) / std)
        v = torch.rand(mean.shape, generator=generator, dtype=mean.dtype)
        p = (low + v * (high - low)).clamp(1e-6, 1 - 1e-6)
        quantile = math.sqrt(2) * torch.erfinv(2 * p - 1)
        straight = (mean + std * quantile).clamp(0.0, 1.0)
        around = mean + std * torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        return torch.where(self.periodic[:, 0], around - around.floor(), straight)

    def draw_mixture(self, generator: torch.Generator) -> Tensor:
        """Draw (..., d), each axis by itself."""
        return self.draw(choose(self.weight, generator), generator)

    def _mass(self) -> Tensor:
        """Of each Gaussian within [0, 1]."""
        inside = _phi((1 - self.mean) / self.std) - _phi(-self.mean / self.std)
        return inside.clamp_min(1e-6)


def choose(log_weight: Tensor, generator: torch.Generator) -> Tensor:
    """Draw indices (...) by the weights exp(log_weight) (..., K)."""
    flat = log_weight.exp().reshape(-1, log_weight.shape[-1])
    return torch.multinomial(flat, 1, generator=generator).reshape(log_weight.shape[:-1])


def fourier(u: Tensor, periodic: Tensor) -> Tensor:
    """What a network gets of coordinates u (..., d): waves of several lengths, (..., d, 9).

    periodic: (d,) bool; on these axes 0 and 1 give the same.
    """
    turns = 2 * math.pi * u[..., None] * u.new_tensor(_FREQUENCIES)
    line = torch.where(periodic, u.new_zeros(()), 2 * u - 1)
    return torch.cat([line[..., None], turns.cos(), turns.sin()], dim=-1)


def frequencies() -> int:
    """How many numbers `fourier` gives for each coordinate."""
    return 1 + 2 * len(_FREQUENCIES)


def _largest(periodic: Tensor) -> Tensor:
    """Standard deviations in single precision, for axes that wrap around and for others."""
    return torch.where(periodic, _LARGEST_PERIODIC, _LARGEST).float()


def _phi(z: Tensor) -> Tensor:
    return 0.5 * (1 + torch.erf(z / math.sqrt(2)))
