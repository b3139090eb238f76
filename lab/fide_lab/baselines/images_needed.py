"""What baselines that learn from images refuse: no target, and losses without the images."""

from __future__ import annotations

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32

__all__ = ["needed_images", "needed_target"]


def needed_target(name: str, target: Float32 | None) -> Float32:
    """The target (H, W, 3) of the baseline `name`; ImageError (a ValueError) if it has none."""
    if target is None:
        raise ImageError(f"{name} learns from images and needs a target; got none")
    return target


def needed_images(name: str, batch: Float32 | None) -> Float32:
    """The images (n, H, W, 3) told to the baseline `name`; ImageError (a ValueError) for None."""
    if batch is None:
        raise ImageError(f"{name} learns from images: tell them, losses alone are no use")
    return batch
