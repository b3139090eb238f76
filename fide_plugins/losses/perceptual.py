"""The `perceptual` loss: multi-scale structure and color, robust against Monte Carlo noise.

v_l      image in opponent colors (Y, Cb, Cr), averaged with Gaussians whose width is their spacing,
         sqrt(H W) 2^l / 56, for l = 0..3; coarser scales average the samples of the finest one
w_l      the same averages of the image times a checkerboard, +1 and -1 at neighboring pixels
g_l, h_l differences of neighboring samples of v_l and w_l, right and down, all three colors (six)
M        local mean: Gaussian of 2 samples width, at every second sample
(a)_b    a, but not less than b / 10

    loss = 1/4 sum_l  mean  (M |g_l - g'_l|^2 - M |h_l - h'_l|^2)_(M |g_l - g'_l|^2)
                            / (M |g_l|^2 + M |g'_l|^2 + c)
           + 4 (mean |v_3 - v'_3|^2 - mean |w_3 - w'_3|^2)_(mean |v_3 - v'_3|^2)

with g', h', v', w' of the target, and c = 0.001, the square of a contrast typical of noise.  The
subtracted terms: noise that is independent between pixels has the same statistics on a
checkerboard, where structures wider than a pixel add almost nothing.  Below 84 x 84 pixels nothing
is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from scipy.sparse import diags_array

from fide_plugins.losses.base import LossOfTarget
from fide_plugins.losses.scales import gaussian_means, planes, resample, samples_at
from fide_plugins.types import Float32

LEVELS = 4
FLOOR = np.float32(1e-3)  # c
LEAST = 0.1  # smallest fraction of a square that remains when noise is subtracted
COLOR_WEIGHT = 4.0
# rows: Y, Cb, Cr of Rec. 601, as weights of R, G, B
OPPONENT = np.array(
    [[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], np.float32
)
FINEST = 1 / 56  # spacing of the finest samples, relative to sqrt(H W)
NOISE_FROM = 1.5  # least spacing of the finest samples, in pixels, for which noise is subtracted

Weights = tuple[Any, Any]  # weights of samples along both axes


@dataclass(frozen=True)
class _Level:
    """Weights of samples and of local means along both axes, in the order of the arrays."""

    samples: Weights
    local: Weights


@dataclass(frozen=True)
class _Structure:
    """Features of one image at one scale; k = 2 with the checkerboard."""

    colors: Float32
    gradient: Float32
    energy: Float32


class PerceptualLoss(LossOfTarget):
    """Contrast-normalized difference of gradients at four scales, plus coarse color."""

    name = "perceptual"
    version = "perceptual-2"

    def __init__(self, target: object) -> None:
        super().__init__(target)
        height, width, _ = self.target.shape
        self.levels = _levels(height, width)
        self.samplers = [self.levels[0].samples]  # of picture and checkerboard
        if FINEST * sqrt(height * width) >= NOISE_FROM:
            self.samplers.append(_on_checkerboard(self.levels[0].samples))
        self._structure = self._features(self.target)

    def _features(self, image: Float32) -> list[_Structure]:
        pixels = planes(image)
        sampled = [_opponent(resample(pixels, *weights)) for weights in self.samplers]
        finest = np.stack(sampled, axis=1)  # (a, k, 3, b)
        coarser = (resample(finest, *level.samples) for level in self.levels[1:])  # (a, b, k, 3)
        last = (np.ascontiguousarray(np.moveaxis(x, 1, -1)) for x in coarser)
        return [_structure(finest), *map(_structure, last)]

    def _distance(self, image: Float32) -> float:
        total = 0.0
        features = self._features(image)
        for own, target, level in zip(features, self._structure, self.levels, strict=True):
            squares = _sum_of_squares(own.gradient - target.gradient)  # [a, k, b]
            contrast = own.energy + target.energy
            means = resample(np.concatenate([squares, contrast], axis=1), *level.local)
            ratio = _without_noise(means[..., :-1]) / (means[..., -1] + FLOOR)
            total += float(ratio.mean(dtype=np.float64))
        coarse = np.square(features[-1].colors - self._structure[-1].colors).sum(axis=2)
        color = _without_noise(coarse.mean(axis=(0, 2), dtype=np.float64))
        return total / LEVELS + COLOR_WEIGHT * float(color)


def _levels(height: int, width: int) -> list[_Level]:
    """Weights of all scales; each sampling exchanges the axes."""
    unit = FINEST * sqrt(height * width)
    h, w = samples_at(height, unit), samples_at(width, unit)
    sampled = (gaussian_means(height, h, unit), gaussian_means(width, w, unit))
    levels = [_Level(sampled, (_local(w), _local(h)))]
    for level in range(1, LEVELS):
        spacing = unit * 2**level
        rows, columns = samples_at(height, spacing), samples_at(width, spacing)
        blur = sqrt(spacing**2 - unit**2)  # on top of the finest one's
        sampled = (
            gaussian_means(w, columns, blur * w / width),
            gaussian_means(h, rows, blur * h / height),
        )
        levels.append(_Level(sampled, (_local(rows), _local(columns))))
    return levels


def _local(samples: int) -> Any:
    return gaussian_means(samples, samples_at(samples, 2.0), 2.0)


def _on_checkerboard(weights: Weights) -> Weights:
    """Weights that sample the image times a checkerboard, as `weights` sample the image."""
    down, across = (w @ diags_array((-1.0) ** np.arange(w.shape[1])) for w in weights)
    return down.astype(np.float32).tocsr(), across.astype(np.float32).tocsr()


def _opponent(rgb: Float32) -> Float32:
    """Opponent colors (a, 3, b) of (a, b, 3)."""
    with np.errstate(under="ignore"):  # of a target that is nearly black
        colors: Float32 = (rgb.reshape(-1, 3) @ OPPONENT.T).reshape(rgb.shape)
    return colors.transpose(0, 2, 1)


def _structure(colors: Float32) -> _Structure:
    a, k, _, b = colors.shape
    gradient = np.zeros((a, k, 6, b), np.float32)
    np.subtract(colors[1:], colors[:-1], out=gradient[:-1, :, :3])
    np.subtract(colors[..., 1:], colors[..., :-1], out=gradient[:, :, 3:, :-1])
    return _Structure(colors, gradient, _sum_of_squares(gradient[:, :1]))


def _sum_of_squares(gradient: Float32) -> Float32:
    """Of gradients [a, k, 6, b], [a, k, b]."""
    squares: Float32 = np.einsum("akcb,akcb->akb", gradient, gradient)
    return squares


def _without_noise(squares: Any) -> Any:
    """Squares of the picture minus those of the checkerboard, from (..., k), or a tenth."""
    if squares.shape[-1] == 1:
        return squares[..., 0]
    return np.maximum(squares[..., 0] - squares[..., 1], LEAST * squares[..., 0])
