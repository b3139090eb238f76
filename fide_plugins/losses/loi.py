"""The `loi` loss: distance of locally orderless images.

A locally orderless image (Koenderink and van Doorn, "The structure of locally orderless images",
IJCV 1999) keeps, at each place, the histogram of the values around it, but not their order.  So
images that differ by a small displacement or by texture have a small distance, and a displaced
object changes the loss over the whole extent of the histograms.  Mehta, Chandraker and
Ramamoorthi, "Locally orderless images for optimization in differentiable rendering", CVPR 2025, use
it as a loss for inverse rendering, with the Wasserstein distance between the histograms.

Notation
--------
I            image, one color channel, (H, W)
sigma        spatial scale, also called inner: I_sigma = G_sigma * I, a finite resolution
beta         tonal scale: width of the Gaussian that stands for one value in a histogram
alpha        extent scale, also called outer: width of the Gaussian window of a histogram
t_k          tones, K of them, equally spaced over [-beta, 1 + beta]
F_k(x)       cumulative histogram around x: the fraction of values below the tone t_k

             F_k = G_alpha * Phi((t_k - I_sigma) / beta),      Phi the normal distribution function

Distance to the target's F', which is 0 if and only if all F are equal:

             mean over pairs (sigma, alpha), channels, places x, of   sum_k |F_k - F'_k| (t_2 - t_1)

The sum is the 1-Wasserstein (earth mover's) distance of the two local histograms, in units of
tones: 1 is the distance between black and white (apart from the smoothing beta beyond the tones).

Deviations from the definition, all for speed: I_sigma and F are evaluated on grids whose spacing
equals their scale, not at every pixel; Phi is a formula with an error of 2e-4; windows are
cut off at the image's borders and renormalized.  Deviations from Mehta et al.: chosen pairs instead
of all combinations, scales relative to the size of the image, cumulative histograms taken directly
from Phi (no normalization of bins), beta-smeared tones just beyond [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.losses.base import LossOfTarget
from fide_plugins.losses.scales import gaussian_means, planes, resample, samples_at
from fide_plugins.types import Float32
from fide_plugins.validation.points import whole_number

__all__ = ["LocallyOrderlessLoss"]

SCALES = ((0.025, 0.03), (0.025, 0.1), (0.025, 0.3), (0.1, 0.3))


@dataclass(frozen=True)
class _Inner:
    """One inner scale and its extents: weights [samples, pixels], then [places, samples]."""

    down: Any
    across: Any
    extents: list[tuple[Any, Any]]


class LocallyOrderlessLoss(LossOfTarget):
    """Mean 1-Wasserstein distance of local histograms.

    Parameters
    ----------
    target
        any input of `as_target`.
    scales
        pairs (sigma, alpha) of spatial scale and extent, relative to sqrt(H W).  A spatial scale of
        0 uses the pixels themselves; an infinite extent is the histogram of the whole image.
    tonal
        tonal scale beta, > 0, in units of values.
    tones
        number K >= 2 of tones at which cumulative histograms are compared.
    """

    name = "loi"
    version = "loi-1"

    def __init__(
        self,
        target: object,
        *,
        scales: Iterable[tuple[float, float]] = SCALES,
        tonal: float = 1 / 8,
        tones: int = 8,
    ) -> None:
        super().__init__(target)
        pairs = _as_pairs(scales)
        self.tonal = _as_positive("tonal", tonal)
        count = whole_number("tones", tones, 2)
        self.tones = np.linspace(-self.tonal, 1 + self.tonal, count, dtype=np.float32)
        height, width, _ = self.target.shape
        self._pyramid = [
            _inner(height, width, sigma, sorted({alpha for s, alpha in pairs if s == sigma}))
            for sigma in sorted({sigma for sigma, _ in pairs})
        ]
        self._histograms = self.histograms(self.target)

    def histograms(self, image: Float32) -> list[Float32]:
        """Cumulative histograms of a canonical image, for each pair of scales.

        Each is float32 (rows, columns, 3, K): a grid of places, color channel, tone.
        """
        pixels = planes(image)
        out = []
        for inner in self._pyramid:
            isophotes = self._isophotes(resample(pixels, inner.down, inner.across))
            out += [resample(isophotes, across, down) for down, across in inner.extents]
        return out

    def _isophotes(self, values: Float32) -> Float32:
        """Phi((t_k - I_sigma) / beta) of I_sigma (w, h, 3), as (w, 3, K, h)."""
        values = np.ascontiguousarray(values.transpose(0, 2, 1))
        x = np.subtract(self.tones[:, None], values[:, :, None, :])
        x *= np.float32(1 / self.tonal)
        return _normal_cdf(x)

    def _distance(self, image: Float32) -> float:
        spacing = float(self.tones[1] - self.tones[0])
        total = 0.0
        for own, target in zip(self.histograms(image), self._histograms, strict=True):
            difference = np.abs(own - target)
            total += float(difference.mean(dtype=np.float64))
        return total * spacing * len(self.tones) / len(self._histograms)


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


def _inner(height: int, width: int, sigma: float, extents: Sequence[float]) -> _Inner:
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


def _as_pairs(scales: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    try:
        pairs = [(float(inner), float(extent)) for inner, extent in scales]
    except (TypeError, ValueError):
        pairs = []
    if not pairs or not all(0 <= inner < inf and extent >= 0 for inner, extent in pairs):
        raise OptionError(
            "scales must be pairs (spatial, extent), at least one, with 0 <= spatial < inf and "
            f"extent >= 0, not {scales!r}"
        )
    return pairs


def _as_positive(name: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = 0.0
    if not 0 < number < inf:
        raise OptionError(f"{name} must be a positive number, not {value!r}")
    return number
