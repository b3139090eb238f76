"""Calibration after training: one scale for all standard deviations of a density.

A network that has seen its renders several times is too sure of itself. One number mends it, as in
temperature scaling (Guo et al. 2017, arXiv:1706.04599). It is chosen by held-out renders, which do
not judge the model: their 90 % regions hold the truth in 90 %. (The scale of the largest likelihood
is not that one: it is decided by most of the renders, and those that are far off are further off
than a Gaussian's.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from fide_plugins.learning.networks.network import Network, as_input
from fide_plugins.learning.renders.renderer import Pixels
from fide_plugins.types import Float64, Mask

__all__ = [
    "COVERAGE",
    "DRAWS",
    "ENOUGH",
    "LARGEST_SCALE",
    "OnPicture",
    "fitted_scale",
    "in_region",
    "split_held_out",
]

LARGEST_SCALE = 4.0
COVERAGE = 0.9  # of the region of highest density
DRAWS = 99  # so that a calibrated truth is among the 90 densest of 100 in 90 %
_STEP = 1.2
_MOST_SCALES = 1 + math.ceil(math.log(LARGEST_SCALE) / math.log(_STEP))  # that are tried
_FEWEST, _MOST = 50, 300  # renders: they tell their share to 4 %, and to 2 %
ENOUGH = 2 * _FEWEST  # held-out renders for a scale, which half of them choose

OnPicture: TypeAlias = Callable[[int, int], None]
"""Called after each held-out picture with how many are done, and how many there are at most."""


def split_held_out(
    aside: Mask,
) -> tuple[Mask, Mask]:
    """Split held-out renders (n,) bool into those that choose the scale and those that judge.

    Every second one chooses, at most 300; none, and so no scale, where these were fewer than 50.
    """
    fit, held_out = np.zeros_like(aside), np.flatnonzero(aside)
    if len(held_out) >= ENOUGH:
        fit[held_out[::2][:_MOST]] = True
    return fit, aside & ~fit


def fitted_scale(
    network: Network,
    x: Float64,
    images: Pixels,
    seed: int = 0,
    on_picture: OnPicture | None = None,
) -> float:
    """Scale in [1, 4] by which 90 % regions hold 90 % of renders, x (n, d), images (n, H, W, 3).

    Interpolated between steps of 1.2.  1 without renders, or where regions hold 90 % already; they
    are never made smaller, since photographs are further from what was learned than renders are.
    The network is left as it was.  on_picture: a picture counts once for each scale that is tried.
    """
    if not len(x):
        return 1.0
    numbers = count(1)

    def note() -> None:
        if on_picture is not None:
            on_picture(next(numbers), _MOST_SCALES * len(x))

    before, scale = network.scale, 1.0
    try:
        covered = _coverage(network, x, images, scale, seed, note)
        while covered < COVERAGE and scale < LARGEST_SCALE:
            wider = min(_STEP * scale, LARGEST_SCALE)
            more = _coverage(network, x, images, wider, seed, note)
            if more >= COVERAGE:
                part = (COVERAGE - covered) / (more - covered)
                return float(scale * (wider / scale) ** part)
            scale, covered = wider, more
        return scale
    finally:
        network.scale = before


@torch.no_grad()
def in_region(network: Network, image: Tensor, drawn: Tensor, u: Tensor) -> bool:
    """Whether u (d,) is in the region of highest density that holds 90 % of what is drawn (n, d).

    image: (1, 3, H, W).
    """
    density = network.log_prob(image, torch.cat([u[None], drawn]))
    less = int((density[1:] <= density[0]).sum())  # none of a density that is not a number
    return less > (1 - COVERAGE) * len(drawn)


def _coverage(
    network: Network,
    x: Float64,
    images: Pixels,
    scale: float,
    seed: int,
    note: Callable[[], None],
) -> float:
    """Share of renders whose parameters are in their 90 % region; note: called after each."""
    network.scale = scale
    generator = torch.Generator().manual_seed(seed)
    u = torch.from_numpy(x.astype(np.float32))
    inside = []
    for i in range(len(x)):
        image = as_input(images[i : i + 1])
        drawn = network.sample(image, DRAWS, generator)
        inside.append(in_region(network, image, drawn, u[i]))
        note()
    return float(np.mean(inside))
