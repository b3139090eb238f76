"""The `sift` encoder: mean colors and dense SIFT of a grid of patches, without weights.

SIFT (Lowe 2004) describes a place by histograms of the directions of the gradients of the
luminance around it: 4 x 4 cells of 8 directions, of unit length, so that neither brightness nor
contrast counts. Here by kornia's `DenseSIFTDescriptor`, with square roots (RootSIFT, Arandjelović
and Zisserman 2012).

The grid of patches, the despeckling and the smoothing of noisy images are those of `dense`. A patch
has 8 x 8 samples; a cell has 4 x 4 samples, so a descriptor reaches half a patch beyond its own.

Channels of a token (C = 131): 0-2 mean R, G, B, as in `dense`; 3-130 the descriptor, in [0, 1].
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.dense import LUMINANCE, grid, less_noisy
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32

__all__ = ["SiftEncoder"]

SIDE = 8  # samples along the side of a patch
CELL = 4  # samples along the side of a cell
MARGIN = 2  # which centers the descriptor on its patch: 8 j - 2 + 1.5 * 4 - 0.5 = 8 j + 3.5
CHANNELS = 3 + 8 * 4 * 4


@cache
def _descriptor() -> Any:
    from kornia.feature import DenseSIFTDescriptor

    return DenseSIFTDescriptor(8, 4, CELL, stride=SIDE, padding=MARGIN).eval()


class SiftEncoder(PatchEncoder):
    """Mean color and SIFT of patches."""

    name = "sift"
    uses_network = False
    version = "sift-1"
    channel_subsets = (3, None)
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (gh gw, 131)."""
        rows, columns = grid(height, width)
        return rows * columns, CHANNELS

    def _prepare(self, batch: Float32) -> Float32:
        rows, columns = grid(batch.shape[1], batch.shape[2])
        samples = np.empty((len(batch), SIDE * rows, SIDE * columns, 3), np.float32)
        for i, image in enumerate(batch):
            samples[i] = less_noisy(image, *samples.shape[1:3])
        return samples.clip(0.0, 1.0, out=samples)

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        samples = images.permute(0, 3, 1, 2)  # (n, 3, 8 gh, 8 gw)
        colors = torch.nn.functional.avg_pool2d(samples, SIDE)
        luminance = (samples * samples.new_tensor(LUMINANCE)[:, None, None]).sum(1, keepdim=True)
        histograms = _descriptor().to(images.device)(luminance)
        return torch.cat([colors, histograms], dim=1).flatten(2).transpose(1, 2)
