"""Estimates the noise of a single image from the differences of pixels from their local medians.

Where a picture is flat, changes evenly, or has a straight edge, a pixel equals the median of its
3 x 3 neighborhood.  In drawings this holds for most pixels, in a path-traced image for almost none.
So the median over all pixels of that difference is zero for a drawing, and the scale of the noise
for a path-traced image (Hampel 1974, the median absolute deviation).  Curved shading contributes
almost nothing.  The estimate misses noise in less than half of the image, and takes fine texture in
more than half of it for noise.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from fide_plugins.types import Float32

__all__ = ["noise_level", "noise_levels"]

ROWS = 28  # least number of pixel rows that are used, if there are as many


def noise_level(image: Float32, clean: Float32) -> float:
    """Median over pixels of the largest color difference between two images (H, W, 3), >= 0.

    clean: the despeckled image.  For a large image a subset of its rows is used.
    """
    step = max(1, len(image) // ROWS)
    grain = np.abs(image[::step] - clean[::step])
    largest = np.maximum(np.maximum(grain[..., 0], grain[..., 1]), grain[..., 2]).ravel()
    return float(np.sort(largest)[len(largest) // 2])  # np.partition is ten times slower with ties


def noise_levels(images: Tensor, clean: Tensor) -> Tensor:
    """The same (n,) of two batches of planes (n, 3, H, W), on their device."""
    step = max(1, images.shape[2] // ROWS)
    grain = (images[:, :, ::step] - clean[:, :, ::step]).abs()
    largest = grain.amax(dim=1).flatten(1)
    return largest.sort(dim=1).values[:, largest.shape[1] // 2]
