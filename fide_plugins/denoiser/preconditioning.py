"""Preconditioners: the meaning of the network's output.

A preconditioner turns a `Network` into a `Denoise`:

- `x_prediction`: the output is x itself (the published method, after Li and He 2025).
- `whitened`: the parameters are scaled to mean 0 and variance 1, and the output is the scaled
  remainder after the best Gaussian estimate without an image, z / (1 + s^2) (Karras et al. 2022).
"""

from __future__ import annotations

from torch import Tensor

from fide_plugins.denoiser import Denoise, Network

__all__ = ["whitened", "x_prediction"]

CENTER = 0.5  # the start of every search; Algorithm 1 counts parameters from there (mu = 0)


def x_prediction(network: Network) -> Denoise:
    """x_hat = network(z, s), both relative to the center of the unit cube."""

    def denoise(z: Tensor, s: Tensor) -> Tensor:
        return CENTER + network(z - CENTER, s)

    return denoise


def whitened(network: Network, mean: Tensor | float, std: Tensor | float) -> Denoise:
    """Denoiser of data with this `mean` and `std`, [d] or one number for all.

    With u = (z - mean) / std and r = s / std, the estimate is
    u / (1 + r^2) + r / sqrt(1 + r^2) * network(u / sqrt(1 + r^2), r); the network's input and
    its ideal output have variance 1 at every noise level.
    """

    def denoise(z: Tensor, s: Tensor) -> Tensor:
        r = s / std  # [B, d]
        variance = 1 + r * r
        u = (z - mean) / std
        remainder = network(u / variance.sqrt(), r)
        return mean + std * (u / variance + r / variance.sqrt() * remainder)

    return denoise
