"""Resizes images to whole patches, by one rule for all encoders with patches.

Antialiased bilinear resizing brings each side to the nearest positive multiple of the patch size
(a tie goes to the larger one).  Images with a side of less than half a patch are refused.
"""

from __future__ import annotations

import torch

from fide_plugins.errors import ImageError

__all__ = ["count", "fit"]


def count(name: str, patch: int, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of patches for an image of that size.

    Raises ImageError, which names the encoder, if a side is below half a patch.

    >>> count("patch", 16, 100, 100), count("patch", 16, 23, 24)
    ((6, 6), (1, 2))
    """
    smallest = (patch + 1) // 2
    if min(height, width) < smallest:
        raise ImageError(
            f"the {name} encoder needs images of at least {smallest} x {smallest} pixels, half a "
            f"patch, got {height} x {width} (H x W); enlarge them, or use the encoder 'dense'"
        )
    return (height + patch // 2) // patch, (width + patch // 2) // patch


def fit(images: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Resize images (n, H, W, 3) to (n, height, width, 3); the same tensor if it fits already."""
    if images.shape[1:3] == (height, width):
        return images
    resized = torch.nn.functional.interpolate(
        images.permute(0, 3, 1, 2), (height, width), mode="bilinear", antialias=True
    )
    return resized.permute(0, 2, 3, 1)
