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
import torch
from torch import Tensor
from torch.nn.functional import pad

from fide_plugins.runtime.opencv import cv2
from fide_plugins.types import Float32

__all__ = ["SMALLEST", "despeckled", "despeckled_planes"]

SMALLEST = 84  # pixels; images with smaller sqrt(H W) stay as they are


def despeckled(image: Float32) -> Float32:
    """Canonical image (H, W, 3) without specks; the image itself if it is small."""
    height, width, _ = image.shape
    if height * width < SMALLEST**2:
        return image
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), 3), np.float32)


def despeckled_planes(images: Tensor) -> Tensor:
    """The same, bit for bit, of a batch of planes (n, 3, H, W), on their device."""
    height, width = images.shape[2:]
    return images if height * width < SMALLEST**2 else _medians(images)


def _medians(images: Tensor) -> Tensor:
    """Median of 3 x 3 values, from the smallest, middle and largest of each row of three.

    It is the middle one of: the largest of the smallest, the middle of the middle, the smallest of
    the largest (Smith 1996, "Implementing median filters in XC4000E FPGAs").  kornia's
    `median_blur(border_type="replicate")` gives the same on a CPU; on CUDA it copies small batches
    by convolutions, which PyTorch rounds to 10 bits unless TF32 is switched off.
    """
    height, width = images.shape[2:]
    padded = pad(images, (1, 1, 1, 1), mode="replicate")
    rows = _sorted(*(padded[..., j : j + width] for j in range(3)))  # each (n, 3, H + 2, W)
    low, middle, high = ([row[:, :, i : i + height] for i in range(3)] for row in rows)
    largest = torch.maximum(torch.maximum(*low[:2]), low[2])
    smallest = torch.minimum(torch.minimum(*high[:2]), high[2])
    return _sorted(largest, _sorted(*middle)[1], smallest)[1]


def _sorted(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The smallest, the middle and the largest of three, value by value."""
    less, more = torch.minimum(a, b), torch.maximum(a, b)
    middle = torch.maximum(less, torch.minimum(more, c))
    return torch.minimum(less, c), middle, torch.maximum(more, c)
