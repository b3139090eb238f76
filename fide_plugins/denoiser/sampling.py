"""Sampling: Euler's method on the reverse-time ODE.

With noise s = t * std the probability-flow ODE is dz/dt = (z - x_hat(z, s)) / t (Karras et al.
2022, eq. 3 with sigma(t) = t).  An Euler step from t to t' keeps the fraction t'/t of the noise:

    z' = z + (t' - t) * (z - x_hat) / t = x_hat + (t' / t) * (z - x_hat)

All parameters have the same step in t, but each has its own noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from fide_plugins.denoiser import Denoise
from fide_plugins.options import PAPER_SCHEDULE
from fide_plugins.validation.options import check_schedule

__all__ = ["euler", "evenly"]


def evenly(steps: int) -> tuple[float, ...]:
    """Schedule of evenly spaced times from that of the paper; 3 steps give the published one.

    >>> evenly(2), evenly(3) == PAPER_SCHEDULE
    ((0.3, 0.15), True)
    """
    return tuple(round(PAPER_SCHEDULE[0] * (steps - i) / steps, 12) for i in range(steps))


@torch.no_grad()
def euler(denoise: Denoise, z: Tensor, std: Tensor, schedule: Sequence[float]) -> Tensor:
    """Integrate `z` [B, d] from time schedule[0] to time 0.

    std: [d], noise at time 1.  Parameters with std = 0 become the estimate of `denoise`.
    """
    for t, later in pairwise([*check_schedule(schedule), 0.0]):
        x_hat = denoise(z, (t * std).expand_as(z))
        z = x_hat + (later / t) * (z - x_hat)
    return z
