"""Blurring and subsampling in one sparse product: Gaussian means of pixels on a coarser grid.

SciPy computes sparse products in the calling thread, in a fixed order: BLAS would start threads,
which cost more than they gain, and results would depend on the rest of the batch.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isfinite
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from fide_plugins.types import Float32, Float64

REACH = 3.0  # standard deviations at which a Gaussian is cut off


@lru_cache(maxsize=256)
def gaussian_means(pixels: int, samples: int, scale: float) -> Any:
    """Sparse weights [samples, pixels] of Gaussians of standard deviation `scale`, in pixels.

    The Gaussians are centered on `samples` equal parts of a row of `pixels`.  They are cut off at 3
    standard deviations and at the ends of the row, and rows sum to 1.  Scale 0 gives the nearest
    pixel, infinity the mean of all pixels.
    """
    centers = (np.arange(samples) + 0.5) * (pixels / samples) - 0.5
    distance = np.abs(np.arange(pixels) - centers[:, None])
    nearest = distance == distance.min(axis=1, keepdims=True)
    weights: Float64 = nearest.astype(np.float64)
    if scale > 0:
        with np.errstate(under="ignore"):  # far from the center
            weights = np.exp(-0.5 * np.square(distance / scale)) * (distance <= REACH * scale)
        weights = np.where(weights.any(axis=1, keepdims=True), weights, nearest)
    weights /= weights.sum(axis=1, keepdims=True)
    return csr_array(weights.astype(np.float32))


def samples_at(side: int, scale: float) -> int:
    """Number of samples along `side` pixels whose spacing is about the scale."""
    if scale <= 1:
        return side
    return ceil(side / scale) if isfinite(scale) else 1


def planes(image: Float32) -> Float32:
    """Image (h, w, 3) as contiguous (h, 3, w)."""
    return np.ascontiguousarray(image.transpose(0, 2, 1))


def resample(x: Float32, down: Any, across: Any) -> Float32:
    """Means (s, r, ...) of x (h, ..., w), with weights down [r, h] and across [s, w].

    The last axis becomes the first, so a second `resample` restores the order.
    """
    rows = (down @ x.reshape(len(x), -1)).reshape(-1, x.shape[-1])  # (r ..., w)
    out: Float32 = across @ np.ascontiguousarray(rows.T)  # (s, r ...)
    return out.reshape(across.shape[0], down.shape[0], *x.shape[1:-1])
