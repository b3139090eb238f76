"""Loss `texture`: how differently two pictures are made, wherever their parts are.

It compares `statistics` (`encoders.texture`), weighed by the inverse of their covariance over
random textures that are like the target: they have its smoothed spectrum, random phases and
amplitudes, and its colors.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from fide_plugins.encoders.texture import statistics
from fide_plugins.losses.base import LossOfTarget
from fide_plugins.types import Float32, Float64

SAMPLES, SHRINKAGE = 80, 0.3  # random textures, and how far their covariance is made diagonal


def textures_like(target: Float32, number: int) -> list[Float32]:
    """Random textures (H, W, 3) with the smoothed spectrum and the colors of the target.

    A Gaussian field has random waves with the power of the target's ranks; each value becomes the
    color of that rank along the direction in which the target's colors vary most.
    """
    height, width, _ = target.shape
    colors = target.reshape(-1, 3).astype(np.float64)
    _, axes = np.linalg.eigh(np.cov(colors, rowvar=False))
    order = np.argsort(colors @ axes[:, -1], kind="stable")
    sorted_colors = colors[order]
    field = np.empty(len(order))
    field[order] = ndtri((np.arange(len(order)) + 0.5) / len(order))
    amplitude = _smooth_amplitude(field.reshape(height, width))
    rng = np.random.default_rng(0)
    made = []
    for _ in range(number):
        waves = np.fft.fft2(rng.normal(size=(height, width)))
        rank = ndtr(np.fft.ifft2(waves * amplitude).real) * (len(order) - 1)
        below = np.minimum(rank.astype(int), len(order) - 2)
        part = (rank - below)[..., None]
        mixed = sorted_colors[below] * (1 - part) + sorted_colors[below + 1] * part
        made.append(mixed.astype(np.float32))
    return made


def _smooth_amplitude(field: Float64) -> Float64:
    """Amplitudes (H, W) of mean square 1: means of a field's power over rings and directions."""
    height, width = field.shape
    taper = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    power = np.abs(np.fft.fft2((field - field.mean()) * taper)) ** 2
    y, x = np.fft.fftfreq(height)[:, None] * height, np.fft.fftfreq(width)[None] * width
    radius = np.log(np.maximum(np.hypot(y, x), 0.5))
    ring = np.floor(12 * (radius - radius.min()) / (np.ptp(radius) + 1e-9)).astype(int)
    direction = np.round(np.arctan2(np.abs(y), np.abs(x)) / (np.pi / 4)).astype(int)
    group = ring * 3 + direction
    sums = np.bincount(group.ravel(), power.ravel(), group.max() + 1)
    counts = np.bincount(group.ravel(), minlength=group.max() + 1)
    mean = (sums / np.maximum(counts, 1))[group]
    amplitude: Float64 = np.sqrt(mean)
    scale = np.sqrt((amplitude**2).mean())
    return amplitude / scale if scale > 0 else np.ones_like(amplitude)


class TextureLoss(LossOfTarget):
    """Squared distance of `statistics`, by their covariance among textures like the target.

    Divided by their number: about 1 for another picture of the same texture.

    Raises `ImageError` for a target with a side of less than 8 pixels.
    """

    name = "texture"
    version = "texture-1"
    of_places = False

    def __init__(self, target: object) -> None:
        super().__init__(target)
        self._goal = statistics(self.target)
        samples = np.array([statistics(one) for one in textures_like(self.target, SAMPLES)])
        covariance = np.cov(samples.astype(np.float64), rowvar=False)
        diagonal = np.diag(np.diag(covariance))
        mixed = (1 - SHRINKAGE) * covariance + SHRINKAGE * diagonal + 1e-6 * np.eye(len(diagonal))
        # Two pictures of one texture differ by twice the covariance of one.
        self._whiten: Float64 = np.linalg.inv(np.linalg.cholesky(2 * mixed))

    def _distance(self, image: Float32) -> float:
        difference = self._whiten @ (statistics(image) - self._goal).astype(np.float64)
        return float(difference @ difference) / len(difference)
