"""The light that brings a render nearest to the target: gain, offset and curve of each channel.

They are linear in their coefficients, so the nearest ones have a closed form (variable projection:
Golub and Pereyra, 1973): ridge regression toward no change, of the images reduced to at most 28 x
28 pixels, with the weights of robust differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fide_plugins.types import Float32, Float64

__all__ = ["EXPOSURE", "NODES", "SHADING", "Light", "fit_light"]

EXPOSURE, SHADING = "exposure", "shading"
NODES = 3  # of the field of gains, in each direction
RIDGE = 1.0  # on 28 x 28 pixels: squares of pixels that say that the light did not change
_DEVIATION = 0.15  # of the target's values, for which the ridge is that


@dataclass(frozen=True)
class Light:
    """What was done to a render, in values in [0, 1]: gain * x + offset + curve * x^2.

    gain: (k, k, 3), a field of k x k gains, evenly spaced from edge to edge; k = 1: one gain.
    offset, curve: (3,).
    """

    gain: Float64
    offset: Float64
    curve: Float64

    @property
    def gamma(self) -> Float64:
        """(3,), exponent of the power law with the same slope at middle gray; 1: no change."""
        mean = self.gain.mean(axis=(0, 1))
        gamma: Float64 = (mean + self.curve) / np.maximum(mean + self.curve / 2, 1e-6)
        return gamma

    def applied(self, image: Float32) -> Float32:
        """An image (H, W, 3) in this light; its values may leave [0, 1]."""
        gain = self.gain[0, 0]
        if len(self.gain) > 1:
            height, width = image.shape[:2]
            down, across = hats(height, len(self.gain)), hats(width, len(self.gain))
            gain = np.einsum("hi,wj,ijc->hwc", down, across, self.gain, optimize=True)
        made = np.float32(self.curve) * image
        made += np.asarray(gain, np.float32)
        made *= image
        made += np.float32(self.offset)
        return made


@lru_cache(maxsize=64)
def hats(length: int, nodes: int) -> Float32:
    """Hat functions (length, nodes), evenly spaced from edge to edge; they add up to 1."""
    at = (np.arange(length) + 0.5) / length * (nodes - 1)
    return np.maximum(0, 1 - abs(at[:, None] - np.arange(nodes))).astype(np.float32)


def fit_light(
    render: Float32, target: Float32, weights: Float32 | None, kind: str, ridge: float = RIDGE
) -> Light:
    """Light in which a render (h, w, 3) is nearest to the target (h, w, 3), both small.

    weights: (h, w, 1) of pixels; None: all count.
    kind: "exposure" or "shading".
    ridge: strength of the prior toward no change.
    """
    h, w = render.shape[:2]
    k = NODES if kind == SHADING else 1
    y = render.reshape(-1, 3).astype(np.float64)
    terms = np.empty((3, h * w, k * k + 2))
    if k == 1:
        terms[:, :, 0] = y.T
    else:
        field = np.einsum("hi,wj->hwij", hats(h, k), hats(w, k)).reshape(h * w, k * k)
        terms[:, :, : k * k] = y.T[:, :, None] * field
    terms[:, :, -2] = 1.0
    terms[:, :, -1] = (y * y).T
    left = terms.transpose(0, 2, 1)  # (3, p, h w)
    if weights is not None:
        left = left * weights.reshape(1, 1, -1)
    apart = (target.reshape(-1, 3) - y).T[:, :, None]  # (3, h w, 1)
    normal = left @ terms
    prior = ridge * h * w / 784
    normal[:, np.arange(k * k + 2), np.arange(k * k + 2)] += prior
    change = np.linalg.solve(normal, left @ apart)[..., 0]  # (3, p)
    gain = 1 + change[:, : k * k].T.reshape(k, k, 3)
    return Light(gain, change[:, -2].copy(), change[:, -1].copy())
