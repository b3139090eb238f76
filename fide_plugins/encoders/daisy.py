"""The `daisy` encoder: mean colors and DAISY of a grid of patches, without weights.

DAISY (Tola, Lepetit and Fua 2010) describes a place by histograms of the directions of gradients,
averaged by Gaussians: one at the place and four each on two rings around it, which are the wider
the farther out they are. Here by OpenCV's contrib module, without normalization, so that contrast
counts, and times 10, which gives them the spread of the contrasts of `dense`.

The grid of patches, the despeckling and the smoothing of noisy images are those of `dense`. A patch
has 8 x 8 samples; the outer ring has a radius of 8 samples.

Channels of a token (C = 75): 0-2 mean R, G, B, as in `dense`; 3-74 the descriptor.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.dense import LUMINANCE, grid, less_noisy
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32

__all__ = ["DaisyEncoder"]

SIDE = 8  # samples along the side of a patch
RADIUS = 8.0  # of the outer ring, in samples
RINGS, ON_A_RING, DIRECTIONS = 2, 4, 8
GAIN = 10.0
DESCRIPTOR = (1 + RINGS * ON_A_RING) * DIRECTIONS
CHANNELS = 3 + DESCRIPTOR


@cache
def _descriptor() -> Any:
    return cv2.xfeatures2d.DAISY.create(RADIUS, RINGS, ON_A_RING, DIRECTIONS)


@cache
def _centers(rows: int, columns: int) -> Any:
    middle = (SIDE - 1) / 2
    return [
        cv2.KeyPoint(SIDE * j + middle, SIDE * i + middle, float(SIDE), 0.0)
        for i in range(rows)
        for j in range(columns)
    ]


class DaisyEncoder(PatchEncoder):
    """Mean color and DAISY of patches."""

    name = "daisy"
    uses_network = False
    version = "daisy-1"
    channel_subsets = (3, None)
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (gh gw, 75)."""
        rows, columns = grid(height, width)
        return rows * columns, CHANNELS

    def _prepare(self, batch: Float32) -> Float32:
        """Tokens (n, 1, T, C): OpenCV makes them of one image at a time."""
        rows, columns = grid(batch.shape[1], batch.shape[2])
        tokens = np.empty((len(batch), 1, rows * columns, CHANNELS), np.float32)
        for image, token in zip(batch, tokens, strict=True):
            samples = less_noisy(image, SIDE * rows, SIDE * columns).clip(0.0, 1.0)
            token[0, :, :3] = (
                samples.reshape(rows, SIDE, columns, SIDE, 3).mean((1, 3)).reshape(-1, 3)
            )
            gray = np.rint(255 * (samples @ np.array(LUMINANCE, np.float32))).astype(np.uint8)
            token[0, :, 3:] = GAIN * _descriptor().compute(gray, _centers(rows, columns))[1]
        return tokens

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        return images[:, 0]
