"""Blurring and subsampling in one sparse product: Gaussian means around few points of many pixels.

Sparse, because windows are short, and because SciPy's sparse products run in the calling thread:
BLAS starts a thread pool for products of this size, which costs more than it gains, and a hundred
times more when other processes keep the cores busy.  They also add in a fixed order, so results do
not depend on what else is computed with them.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fide_plugins.images import Float32

__all__ = ["gaussian_means", "planes", "resample", "samples_at"]

REACH = 3.0  # standard deviations at which a Gaussian is cut off


@lru_cache(maxsize=256)
def gaussian_means(pixels: int, samples: int, scale: float) -> Any:
    """Sparse weights [samples, pixels] of Gaussians of standard deviation `scale`, in pixels.

    The Gaussians sit at the centers of `samples` equal parts of a row of `pixels`.  They are cut
    off at 3 standard deviations and at the ends of the row, and rows sum to 1.  Scale 0 takes the
    nearest pixel, infinity the mean of all.
    """
    centers = (np.arange(samples) + 0.5) * (pixels / samples) - 0.5
    distance = np.abs(np.arange(pixels) - centers[:, None])
    nearest = distance == distance.min(axis=1, keepdims=True)
    weights: NDArray[np.float64] = nearest.astype(np.float64)
    if scale > 0:
        weights = np.exp(-0.5 * np.square(distance / scale)) * (distance <= REACH * scale)
        weights = np.where(weights.any(axis=1, keepdims=True), weights, nearest)
    weights /= weights.sum(axis=1, keepdims=True)
    return csr_array(weights.astype(np.float32))


def samples_at(side: int, scale: float) -> int:
    """Number of samples along a side of `side` pixels at about the spacing of the scale."""
    if scale <= 1:
        return side
    return ceil(side / scale) if isfinite(scale) else 1


def planes(image: Float32) -> Float32:
    """(h, w, 3) as (h, 3, w), contiguous."""
    return np.ascontiguousarray(image.transpose(0, 2, 1))


def resample(x: Float32, down: Any, across: Any) -> Float32:
    """Means (s, r, ...) of x (h, ..., w), with weights down [r, h] and across [s, w].

    The axis that was last comes first, so a second `resample` would turn it back.
    """
    rows = (down @ x.reshape(len(x), -1)).reshape(-1, x.shape[-1])  # (r ..., w)
    out: Float32 = across @ np.ascontiguousarray(rows.T)  # (s, r ...)
    return out.reshape(across.shape[0], down.shape[0], *x.shape[1:-1])
