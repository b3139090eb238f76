"""Euler's method against closed forms.

For x ~ N(m, v) the exact denoiser is m + v / (v + s^2) (z - m).  An Euler step from s to s'
multiplies z - m by (v + s s') / (v + s^2), and the exact solution of the ODE from s to 0 by
sqrt(v / (v + s^2)).
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_lab.baselines.image_based import whitened
from fide_plugins.denoiser.training import euler
from fide_plugins.options import PAPER_SCHEDULE

MEAN = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
VARIANCE = torch.tensor([0.01, 0.04, 0.25], dtype=torch.float64)
STD = torch.tensor([0.3, 0.1, 0.7], dtype=torch.float64)


def gaussian(z: Tensor, s: Tensor) -> Tensor:
    return MEAN + VARIANCE / (VARIANCE + s * s) * (z - MEAN)


def start() -> Tensor:
    return torch.randn(7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("schedule", [PAPER_SCHEDULE, (1.0, 0.6, 0.3), (2.0,)])
def test_euler_steps_of_a_gaussian(schedule: tuple[float, ...]) -> None:
    factor = torch.ones(3, dtype=torch.float64)
    for t, later in pairwise([*schedule, 0.0]):
        factor *= (VARIANCE + t * later * STD**2) / (VARIANCE + (t * STD) ** 2)
    z = start()
    torch.testing.assert_close(euler(gaussian, z, STD, schedule), MEAN + factor * (z - MEAN))


def test_samples_have_the_law_of_the_data() -> None:
    g = torch.Generator().manual_seed(1)
    prior = MEAN + (VARIANCE + STD**2).sqrt() * torch.randn(20_000, 3, generator=g).double()
    x = euler(gaussian, prior, STD, [1 - i / 500 for i in range(500)])
    np.testing.assert_allclose(x.mean(0), MEAN, atol=4 * 0.5 / math.sqrt(20_000))
    np.testing.assert_allclose(x.var(0), VARIANCE, rtol=0.05)


def test_the_denoiser_is_told_the_noise_of_each_parameter() -> None:
    seen: list[Tensor] = []

    def spy(z: Tensor, s: Tensor) -> Tensor:
        seen.append(s)
        return z

    z = start()
    assert torch.equal(euler(spy, z, STD, PAPER_SCHEDULE), z)
    for s, t in zip(seen, PAPER_SCHEDULE, strict=True):
        torch.testing.assert_close(s, (t * STD).expand(7, 3))


def test_whitened_without_network_is_the_exact_denoiser_of_a_gaussian() -> None:
    denoise = whitened(lambda z, s: torch.zeros_like(z), MEAN, VARIANCE.sqrt())
    z, s = start(), STD.expand(7, 3)
    torch.testing.assert_close(denoise(z, s), gaussian(z, s))
