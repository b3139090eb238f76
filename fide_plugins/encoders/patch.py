"""The `patch` encoder: the raw pixels of each 16 x 16 patch; and how images become whole patches.

It is the published "simple patch embedding" without its learnable layer: the first linear layer of
the network that uses the tokens (768 -> width) is that embedding.
"""

from __future__ import annotations

import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.errors import ImageError
from fide_plugins.runtime.threads import one_thread

PATCH = 16


def patches(name: str, patch: int, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches for an image of that size, each side rounded, ties up.

    Raises ImageError, which names the encoder, if a side is below half a patch.

    >>> patches("patch", 16, 100, 100), patches("patch", 16, 23, 24)
    ((6, 6), (1, 2))
    """
    smallest = (patch + 1) // 2
    if min(height, width) < smallest:
        raise ImageError(
            f"the {name} encoder needs images of at least {smallest} x {smallest} pixels, half a "
            f"patch, got {height} x {width} (H x W); enlarge them, or use the encoder 'dense'"
        )
    return (height + patch // 2) // patch, (width + patch // 2) // patch


def resized(images: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Images (n, H, W, 3) at a size, bilinear and antialiased; the same tensor if they fit."""
    if images.shape[1:3] == (height, width):
        return images
    made = torch.nn.functional.interpolate(
        images.permute(0, 3, 1, 2), (height, width), mode="bilinear", antialias=True
    )
    return made.permute(0, 2, 3, 1)


class RawPatchEncoder(PatchEncoder):
    """Pixels of 16 x 16 patches, row by row, RGB for each: (n, round(H/16) round(W/16), 768)."""

    name = "patch"
    uses_network = False
    version = "patch-1"
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (number of patches, 768)."""
        rows, columns = patches(self.name, PATCH, height, width)
        return rows * columns, PATCH * PATCH * 3

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        n, height, width, _ = images.shape
        rows, columns = patches(self.name, PATCH, height, width)
        images = resized(images, rows * PATCH, columns * PATCH)
        pixels = images.reshape(n, rows, PATCH, columns, PATCH, 3).transpose(2, 3)
        return pixels.reshape(n, rows * columns, PATCH * PATCH * 3)
