"""The `patch` encoder: the raw pixels of each 16 x 16 patch.

It is the published "simple patch embedding" without its learnable layer: the first linear layer of
the network that uses the tokens (768 -> width) is that embedding.

A token holds the pixels of the patch row by row, RGB for each; tokens go row by row over the image.
Images with sides that are no multiple of 16 are resized, see `whole_patches`.
"""

from __future__ import annotations

import torch

from fide_plugins.encoders import whole_patches
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.runtime.threads import one_thread

__all__ = ["RawPatchEncoder"]

PATCH = 16


class RawPatchEncoder(PatchEncoder):
    """Pixels of 16 x 16 patches: (n, T, 768) with T = round(H / 16) round(W / 16)."""

    name = "patch"
    uses_network = False
    version = "patch-1"
    takes_tensors = True
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (number of patches, 768)."""
        rows, columns = whole_patches.count(self.name, PATCH, height, width)
        return rows * columns, PATCH * PATCH * 3

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        n, height, width, _ = images.shape
        rows, columns = whole_patches.count(self.name, PATCH, height, width)
        images = whole_patches.fit(images, rows * PATCH, columns * PATCH)
        pixels = images.reshape(n, rows, PATCH, columns, PATCH, 3).transpose(2, 3)
        return pixels.reshape(n, rows * columns, PATCH * PATCH * 3)
