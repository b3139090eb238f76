"""Sampling: Euler's method on the reverse-time ODE (Karras et al. 2022).

A preconditioner turns a `Network` into a `Denoise`: it says what the network's output means.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from fide_plugins.denoiser import Denoise, Network
from fide_plugins.validation.options import check_schedule

CENTER = 0.5  # the start of every search; Algorithm 1 counts parameters from there (mu = 0)


def x_prediction(network: Network) -> Denoise:
    """x_hat = network(z, s), both relative to the center of the unit cube."""

    def denoise(z: Tensor, s: Tensor) -> Tensor:
        return CENTER + network(z - CENTER, s)

    return denoise


@torch.no_grad()
def euler(denoise: Denoise, z: Tensor, std: Tensor, schedule: Sequence[float]) -> Tensor:
    """Integrate `z` [B, d] from time schedule[0] to time 0.

    A step from t to t' keeps the fraction t'/t of the noise: z' = x_hat + (t' / t) * (z - x_hat).

    std: [d], noise at time 1.  Parameters with std = 0 become the estimate of `denoise`.
    """
    for t, later in pairwise([*check_schedule(schedule), 0.0]):
        x_hat = denoise(z, (t * std).expand_as(z))
        z = x_hat + (later / t) * (z - x_hat)
    return z
