"""The `loi` loss: distance of locally orderless images (Koenderink and van Doorn, IJCV 1999).

They keep, at each place, the histogram of the values around it, but not their order.  Mehta,
Chandraker and Ramamoorthi, CVPR 2025, use it as a loss for inverse rendering.

sigma        spatial scale: I_sigma = G_sigma * I of one color channel
beta         tonal scale: width of the Gaussian that stands for one value in a histogram
alpha        extent scale: width of the Gaussian window of a histogram
t_k          tones, K of them, equally spaced over [-beta, 1 + beta]

    F_k = G_alpha * Phi((t_k - I_sigma) / beta),      Phi the normal distribution function
    loss = mean over pairs (sigma, alpha), channels, places of   sum_k |F_k - F'_k| (t_2 - t_1)

The sum is the 1-Wasserstein distance of two local histograms, in units of tones.  I_sigma and F are
evaluated on grids whose spacing equals their scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from fide_plugins.losses.base import LossOfTarget
from fide_plugins.losses.scales import gaussian_means, planes, resample, samples_at
from fide_plugins.types import Float32

# Extents alpha of each spatial scale sigma, both relative to sqrt(H W).
SCALES = {0.025: (0.03, 0.1, 0.3), 0.1: (0.3,)}
TONAL = 1 / 8  # beta
TONES = np.linspace(-TONAL, 1 + TONAL, 8, dtype=np.float32)  # t_k


@dataclass(frozen=True)
class _Inner:
    """One inner scale and its extents: weights [samples, pixels], then [places, samples]."""

    down: Any
    across: Any
    extents: list[tuple[Any, Any]]


class LocallyOrderlessLoss(LossOfTarget):
    """Mean 1-Wasserstein distance of local histograms."""

    name = "loi"
    version = "loi-1"

    def __init__(self, target: object) -> None:
        super().__init__(target)
        height, width, _ = self.target.shape
        self._pyramid = [_inner(height, width, *scales) for scales in SCALES.items()]
        self._histograms = self.histograms(self.target)

    def histograms(self, image: Float32) -> list[Float32]:
        """Cumulative histograms of a canonical image, for each pair of scales.

        Each is float32 (rows, columns, 3, K): a grid of places, color channel, tone.
        """
        pixels = planes(image)
        out = []
        for inner in self._pyramid:
            isophotes = _isophotes(resample(pixels, inner.down, inner.across))
            out += [resample(isophotes, across, down) for down, across in inner.extents]
        return out

    def _distance(self, image: Float32) -> float:
        total = 0.0
        for own, target in zip(self.histograms(image), self._histograms, strict=True):
            total += float(np.abs(own - target).mean(dtype=np.float64))
        return total * float(TONES[1] - TONES[0]) * len(TONES) / len(self._histograms)


def _isophotes(values: Float32) -> Float32:
    """Phi((t_k - I_sigma) / beta) of I_sigma (w, h, 3), as (w, 3, K, h)."""
    values = np.ascontiguousarray(values.transpose(0, 2, 1))
    x = np.subtract(TONES[:, None], values[:, :, None, :])
    x *= np.float32(1 / TONAL)
    return _normal_cdf(x)


def _normal_cdf(x: Float32) -> Float32:
    """Phi(x), in place, to 2e-4: a logistic function of an odd cubic, so Phi(-x) = 1 - Phi(x)."""
    cubic = np.square(x)
    cubic *= np.float32(-0.07056)
    cubic -= np.float32(1.5976)
    x *= cubic
    with np.errstate(over="ignore"):  # exp(inf): far below all tones, Phi = 0
        np.exp(x, out=x)
        x += np.float32(1)
    return np.reciprocal(x, out=x)


def _inner(height: int, width: int, sigma: float, extents: tuple[float, ...]) -> _Inner:
    unit = sqrt(height * width)
    h, w = samples_at(height, sigma * unit), samples_at(width, sigma * unit)
    return _Inner(
        gaussian_means(height, h, sigma * unit),
        gaussian_means(width, w, sigma * unit),
        [(_extent(height, h, alpha * unit), _extent(width, w, alpha * unit)) for alpha in extents],
    )


def _extent(side: int, samples: int, alpha: float) -> Any:
    """Weights [places, samples] of an extent of `alpha` pixels on samples of a side."""
    places = min(samples_at(side, alpha), samples)
    return gaussian_means(samples, places, alpha * samples / side)
