"""The networks of DiBO: an ensemble that predicts the value, and what diffusion models are made of.

Notation: n points, d parameters, x (n, d) standardized over the buffer, time t (n,) in [0, 1), the
noisiest at 0.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["Ensemble", "NoisePredictor"]

HARMONICS = 64
MEMBERS = 5


def perceptron(dim: int, width: int) -> nn.Sequential:
    """One layer in, three hidden ones, GELU after each, and one number out."""
    layers: list[nn.Module] = [nn.Linear(dim, width), nn.GELU()]
    for _ in range(3):
        layers += [nn.Linear(width, width), nn.GELU()]
    return nn.Sequential(*layers, nn.Linear(width, 1))


class Ensemble(nn.Module):
    """Predictions of the value; where its members disagree, the reward is higher."""

    def __init__(self, dim: int, width: int, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.members = nn.ModuleList(perceptron(dim, width) for _ in range(MEMBERS))

    def forward(self, x: Tensor) -> Tensor:
        """Reward mean + gamma std (n,) of points (n, d)."""
        values = torch.stack([member(x)[:, 0] for member in self.members])  # (members, n)
        reward: Tensor = values.mean(dim=0) + self.gamma * values.std(dim=0)
        return reward


class Residual(nn.Module):
    """x + linear(gelu(norm(x)))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.linear = nn.LayerNorm(width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(n, width) -> (n, width)."""
        out: Tensor = x + self.linear(F.gelu(self.norm(x)))
        return out


class NoisePredictor(nn.Module):
    """Noise epsilon (n, d) in noisy points (n, d), told the time by its harmonics."""

    def __init__(self, dim: int, width: int, depth: int = 3) -> None:
        super().__init__()
        self.inward = nn.Linear(dim, width)
        self.mix = nn.Linear(width + 2 * HARMONICS, width)
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(depth)))
        self.norm, self.outward = nn.LayerNorm(width), nn.Linear(width, dim)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """Noise (n, d) of points x (n, d) at times t (n,)."""
        k = torch.arange(1, HARMONICS + 1, dtype=x.dtype, device=x.device)
        phase = 2 * math.pi * t[:, None] * k  # (n, 64)
        h = self.mix(torch.cat([self.inward(x), phase.sin(), phase.cos()], dim=1))
        out: Tensor = self.outward(F.gelu(self.norm(self.blocks(h))))
        return out
