"""Removes single bright or dark pixels from an image before features are computed.

The noise of Monte Carlo rendering is far from normal: most of its variance is in a few pixels from
which a path happened to reach a lamp.  A mean over many pixels keeps such outliers, a median
removes them.  So each pixel becomes the median of its 3 x 3 neighborhood in each color (Tukey 1977,
"Exploratory data analysis"); beyond the border the outermost pixels are repeated.  Edges stay in
place.  The filter removes lines one pixel wide, so small images, which may consist of such lines,
stay as they are.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.runtime.opencv import cv2
from fide_plugins.types import Float32

__all__ = ["SMALLEST", "despeckled"]

SMALLEST = 84  # pixels; images with smaller sqrt(H W) stay as they are


def despeckled(image: Float32) -> Float32:
    """Canonical image (H, W, 3) without specks; the image itself if it is small."""
    height, width, _ = image.shape
    if height * width < SMALLEST**2:
        return image
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), 3), np.float32)
