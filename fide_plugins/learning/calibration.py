"""Calibration after training: one scale for all standard deviations of a density.

A network that has seen its renders several times is too sure of itself. As by temperature scaling
(Guo et al. 2017, arXiv:1706.04599), a single number mends it without changing which hypothesis
comes first: the scale by which the likelihood of held-out renders is largest. These renders do not
judge the model.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from fide_plugins.learning.network import Network, as_input
from fide_plugins.learning.renderer import Pixels
from fide_plugins.types import Float64

__all__ = ["LARGEST", "SMALLEST", "fitted_scale", "shares"]

SMALLEST, LARGEST = 0.25, 4.0
_FEWEST = 20  # renders: with 4 parameters they tell the scale to about 8 %
_BATCH = 500
_EXACT = 1e-3  # of the logarithm of the scale


def shares(
    aside: npt.NDArray[np.bool_],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Split held-out renders (n,) bool into those that choose the scale and those that judge.

    Every second one chooses; none, and so no scale, where these would be fewer than 20.
    """
    fit, held_out = np.zeros_like(aside), np.flatnonzero(aside)
    if len(held_out) >= 2 * _FEWEST:
        fit[held_out[::2]] = True
    return fit, aside & ~fit


@torch.no_grad()
def fitted_scale(network: Network, x: Float64, images: Pixels) -> float:
    """Scale in [1/4, 4] by which renders are likeliest, x (n, d) and images (n, H, W, 3).

    1 without renders.  The network is left as it was.
    """
    if not len(x):
        return 1.0
    before, features = network.scale, _features(network, x, images)

    def nll(logarithm: float) -> float:
        network.scale = math.exp(logarithm)
        each = [network.density.log_prob(*some) for some in features]
        return -float(torch.cat(each).mean())

    try:
        bounds = (math.log(SMALLEST), math.log(LARGEST))
        found = minimize_scalar(nll, bounds=bounds, method="bounded", options={"xatol": _EXACT})
    finally:
        network.scale = before
    return math.exp(found.x)


def _features(network: Network, x: Float64, images: Pixels) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Batches of what the head takes: places, vectors and parameters of the renders."""
    u = torch.from_numpy(x.astype(np.float32))
    parts = [slice(i, i + _BATCH) for i in range(0, len(x), _BATCH)]
    return [(*network.encoder(as_input(images[some])), u[some]) for some in parts]
