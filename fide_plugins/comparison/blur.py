"""Pictures behind a Gaussian filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins.types import Float32

__all__ = ["blurred"]


def blurred(image: Float32, blur: float) -> Float32:
    """An image (H, W, C) behind a Gaussian filter, with its own pixels beyond the border.

    blur: standard deviation in pixels; a large one filters a smaller image.
    """
    if not blur:
        return image
    from fide_plugins.runtime.opencv import cv2

    height, width = image.shape[:2]
    factor = max(1, int(blur / 2))
    size = max(1, round(width / factor)), max(1, round(height / factor))
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1 else image
    small = cv2.GaussianBlur(small, (0, 0), blur / factor, borderType=cv2.BORDER_REPLICATE)
    if factor > 1:
        small = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, np.float32).reshape(image.shape)
