"""The light that brings a render nearest to the target: gain, offset and curve of each channel.

They are linear in their coefficients, so the nearest ones have a closed form (variable projection:
Golub and Pereyra, 1973): ridge regression toward no change, of images of at most 28 x 28 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from fide_plugins.runtime.opencv import cv2
from fide_plugins.types import Float32, Float64

NONE, EXPOSURE, SHADING = "none", "exposure", "shading"
_NODES = 3  # of the field of gains, in each direction
_RIDGE, _COMMON_RIDGE = 0.006, 1e-5  # of a render's own light, of one that all have
_LEAST_VARIANCE = 1e-4
_MORE_NODES = (3, 3, 5, 5, 9, 9)  # of the field of a common light, fit after fit
_SPREAD, _LEAST_SPREAD = 2.0, 0.01  # times the median difference: scale of robust ones; at least
_COMMON = 0.02  # median difference that is left in a common light
_LEAST_SLOPE = 0.1  # of the values after over those before: no light turns black into white


@dataclass(frozen=True)
class Light:
    """What was done to a render, in values in [0, 1]: gain * x + offset + curve * x^2.

    gain: (k, k, 3), gains on a grid from edge to edge, linear in between; k = 1: one everywhere.
    offset, curve: (3,).
    """

    gain: Float64
    offset: Float64
    curve: Float64

    @property
    def gamma(self) -> Float64:
        """(3,), exponent of the power law with the same slope at middle gray; 1: no change."""
        gain = self.gain.mean(axis=(0, 1))
        gamma: Float64 = (gain + self.curve) / np.maximum(gain + self.curve / 2, 1e-6)
        return gamma

    def applied(self, image: Float32) -> Float32:
        """An image (H, W, 3) in this light; its values may leave [0, 1]."""
        squares = cv2.transform(cv2.multiply(image, image), np.diag(self.curve))
        if len(self.gain) == 1:
            affine = np.column_stack([np.diag(self.gain[0, 0]), self.offset])
            moved = cv2.transform(image, affine)
            return np.asarray(cv2.add(moved, squares), np.float32)
        height, width = image.shape[:2]
        down, across = _hats(height, len(self.gain)), _hats(width, len(self.gain))
        rows = np.tensordot(across, self.gain.astype(np.float32), (1, 1))  # (W, k, 3)
        gain = np.tensordot(down, rows, (1, 1))  # (H, W, 3)
        shift: Any = (*self.offset, 0.0)
        moved = cv2.add(np.asarray(cv2.multiply(gain, image), np.float32), shift)
        return np.asarray(cv2.add(moved, squares), np.float32)


@lru_cache(maxsize=64)
def _hats(length: int, nodes: int) -> Float32:
    """Hat functions (length, nodes), evenly spaced from edge to edge; they add up to 1."""
    at = (np.arange(length) + 0.5) / length * (nodes - 1)
    return np.maximum(0, 1 - abs(at[:, None] - np.arange(nodes))).astype(np.float32)


@lru_cache(maxsize=16)
def _field(height: int, width: int, nodes: int) -> Float32:
    """Products of hat functions (k k, height width)."""
    down, across = _hats(height, nodes), _hats(width, nodes)
    field: Float32 = np.einsum("hi,wj->ijhw", down, across).reshape(nodes**2, -1)
    return field


def fit_light(
    render: Float32, target: Float32, weights: Float32 | None, kind: str,
    nodes: int = _NODES, ridge: float = _RIDGE,
) -> Light:  # fmt: skip
    """Light in which a render (h, w, 3) is nearest to the target (h, w, 3), both small.

    weights: (h, w) of pixels; None: all count.
    kind: "exposure" or "shading".  nodes: of a field of gains, in each direction.
    ridge: of the target's variance, summed over the pixels: what says that nothing changed.
    """
    h, w = render.shape[:2]
    y = np.ascontiguousarray(render.reshape(-1, 3).T)  # (3, h w)
    k = nodes if kind == SHADING else 1
    p = k * k + 2
    # In double precision: the ridge of a flat render is smaller than the rounding of single.
    terms = np.empty((3, p, h * w), np.float64)
    terms[:, : k * k] = y[:, None] if k == 1 else y[:, None] * _field(h, w, k)
    terms[:, -2] = 1
    np.multiply(y, y, out=terms[:, -1])
    apart = target.reshape(-1, 3).T - y
    weighted = terms if weights is None else terms * weights.reshape(-1)
    normal = weighted @ terms.transpose(0, 2, 1)  # (3, p, p)
    variance = max(float(target.reshape(-1, 3).var(axis=0).mean()), _LEAST_VARIANCE)
    normal[:, np.arange(p), np.arange(p)] += ridge * variance * h * w
    change = np.linalg.solve(normal, weighted @ apart[..., None])[..., 0]
    gains = 1 + change[:, : k * k].min(axis=1)
    slope = np.minimum(gains, gains + 2 * change[:, -1])  # the least, at black or white
    steep = np.minimum(1.0, (1 - _LEAST_SLOPE) / np.maximum(1 - slope, 1e-9))
    change *= steep[:, None]
    gain = 1 + change[:, : k * k].T.reshape(k, k, 3)
    return Light(gain, change[:, -2].copy(), change[:, -1].copy())


def robust_light(
    render: Float32, target: Float32, weights: Float32 | None, kind: str, scale: float | None
) -> Light:
    """By `fit_light`; with a scale again, with the weights of robust differences."""
    light = fit_light(render, target, weights, kind)
    if scale is None:
        return light
    robust = np.square(robust_factor(light.applied(render) - target, scale))
    return fit_light(render, target, robust if weights is None else weights * robust, kind)


def common_light(
    renders: Float32, target: Float32, weights: Float32 | None, kind: str
) -> Light | None:
    """Light of a photograph (h, w, 3) by what most renders (n, h, w, 3) have; None: it is unknown.

    The median render has what does not move.  Where most of it is like the target but for the
    light, this is that of all renders: a light of its own hides what is wrong with a render.
    """
    usual = np.ascontiguousarray(np.median(renders, axis=0), np.float32)
    moves = np.abs(renders - usual).mean(axis=(0, 3))
    light = fit_light(usual, target, weights, kind)
    for nodes in _MORE_NODES:
        apart = light.applied(usual) - target
        scale = max(_SPREAD * _median(apart), _LEAST_SPREAD)
        robust = np.square(robust_factor(apart, scale)) / (1 + np.square(moves / scale))
        robust = robust if weights is None else robust * weights
        light = fit_light(usual, target, robust, kind, nodes, _COMMON_RIDGE)
    return light if _median(light.applied(usual) - target) < _COMMON else None


def _median(apart: Float32) -> float:
    return float(np.median(np.sqrt(np.square(apart).mean(axis=-1))))


def robust_factor(apart: Float32, scale: float) -> Float32:
    """C / sqrt(c^2 + d^2), (H, W), of differences (H, W, 3); d^2: their mean square."""
    mean = np.full((1, 3), 1 / (3 * scale * scale))
    squares = np.asarray(cv2.transform(cv2.multiply(apart, apart), mean), np.float32)
    return np.asarray(1 / np.sqrt(1 + squares), np.float32)
