"""The `patch` encoder: the raw pixels of each 16 x 16 patch.

It is the published "simple patch embedding" without its learnable layer, which belongs to whoever
learns: the first linear layer after the tokens (768 -> width) is that embedding.

A token holds the patch's pixels row by row, RGB of each; tokens go row by row over the image.
Sides that are no multiple of 16 are brought to the nearest one, at least 16 (exactly between two:
the larger), by antialiased bilinear resizing.  Images with a side of less than 8 pixels, half a
patch, are refused.
"""

from __future__ import annotations

from typing import ClassVar

import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.errors import ImageError

__all__ = ["RawPatchEncoder"]

PATCH = 16


class RawPatchEncoder(PatchEncoder):
    """Pixels of 16 x 16 patches: (n, T, 768) with T = round(H / 16) round(W / 16)."""

    name: ClassVar[str] = "patch"
    version: ClassVar[str] = "patch-1"

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) = (number of patches, 768)."""
        rows, columns = _patches(height, width)
        return rows * columns, PATCH * PATCH * 3

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        n, height, width, _ = images.shape
        rows, columns = _patches(height, width)
        if (height, width) != (rows * PATCH, columns * PATCH):
            images = _resize(images, rows * PATCH, columns * PATCH)
        pixels = images.reshape(n, rows, PATCH, columns, PATCH, 3).transpose(2, 3)
        return pixels.reshape(n, rows * columns, PATCH * PATCH * 3)


def _patches(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches for an image of that size."""
    if min(height, width) < PATCH // 2:
        raise ImageError(
            f"the patch encoder needs images of at least {PATCH // 2} x {PATCH // 2} pixels, half "
            f"a patch, got {height} x {width} (H x W); enlarge them, or use the encoder 'dense'"
        )
    return (height + PATCH // 2) // PATCH, (width + PATCH // 2) // PATCH


def _resize(images: torch.Tensor, height: int, width: int) -> torch.Tensor:
    resized = torch.nn.functional.interpolate(
        images.permute(0, 3, 1, 2), (height, width), mode="bilinear", antialias=True
    )
    return resized.permute(0, 2, 3, 1)
