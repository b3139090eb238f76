"""OpenCV's bilateral filter (Tomasi and Manduchi 1998) of a batch of tensors, on their device.

kornia's `bilateral_blur` is not it: its window is a square, OpenCV's a disk.  OpenCV reads the
weights of colors from a table, which changes them by less than 1e-7.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["bilateral"]


def bilateral(images: Tensor, diameter: int, tones: float, reach: float) -> Tensor:
    """Filtered images (n, 3, h, w), as by `cv2.bilateralFilter(image, diameter, tones, reach)`.

    diameter: of the window, odd, in pixels.
    tones: standard deviation of the weights for the sum of the color differences, in values.
    reach: standard deviation of the weights for distances, in pixels.

    Beyond the border the image is mirrored at its outermost pixels.
    """
    radius, (height, width) = diameter // 2, images.shape[2:]
    rows, columns = (_mirrored(side, radius).to(images.device) for side in (height, width))
    padded = images[:, :, rows][..., columns]
    total, weights = torch.zeros_like(images), torch.zeros_like(images[:, :1])
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            if math.hypot(i, j) > radius:
                continue
            top, left = radius + i, radius + j
            other = padded[:, :, top : top + height, left : left + width]
            difference = (other - images).abs().sum(1, keepdim=True)
            near = -0.5 * (i * i + j * j) / reach**2
            weight = torch.exp(near - 0.5 * (difference / tones).square())
            total, weights = total + weight * other, weights + weight
    return total / weights


def _mirrored(side: int, radius: int) -> Tensor:
    """Which of `side` pixels is shown at -radius, ..., side + radius - 1.

    PyTorch's own padding mirrors no farther than the image reaches.
    """
    if side == 1:
        return torch.zeros(1 + 2 * radius, dtype=torch.int64)
    places = torch.arange(-radius, side + radius).remainder(2 * side - 2)
    return torch.minimum(places, 2 * side - 2 - places)
