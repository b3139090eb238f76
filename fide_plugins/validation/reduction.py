"""Pictures made smaller: each pixel is a mean of those that it covers, weighted by a mask."""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float32
from fide_plugins.validation.image_sources import Pixels

__all__ = ["reduced", "reduced_size", "shrunk"]


def reduced_size(size: tuple[int, ...], max_side: int) -> tuple[int, int]:
    """Width and height with the longer one at most `max_side`."""
    if max(size) <= max_side:
        return size[0], size[1]
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    return width, height


def reduced(pixels: Pixels, size: tuple[int, int], weights: Pixels | None = None) -> Pixels:
    """Pixels (H, W) or (H, W, C) in the size (width, height); themselves if they have it.

    They come back as float32, whole numbers too, in their own range.  Colors of four channels are
    weighted by the last one, the alpha channel.  What has no weight at all becomes 0.

    weights: (H, W), of pixels; those of 0 have no influence, whatever they hold.
    """
    if pixels.shape[1::-1] == size:
        return pixels
    values: Float32 = pixels.astype(np.float32)
    if weights is not None and values.ndim == 3 and values.shape[2] == 4:
        alpha = np.where(weights > 0, values[..., 3], 0)
    elif values.ndim == 3 and values.shape[2] == 4:
        alpha = values[..., 3]
    else:
        alpha = None
    if alpha is None:
        return _mean(values, size, weights)
    opacity = _mean(alpha, size, weights)
    colors = _mean(values[..., :3], size, alpha if weights is None else alpha * weights)
    return np.concatenate([colors, opacity[..., None]], axis=-1)


def shrunk(
    pixels: Pixels, weights: Float32 | None, max_side: int | None, *, raw: bool = False
) -> tuple[Pixels, Float32 | None]:
    """Pixels and their weights (H, W), where a side has more than `max_side` pixels smaller.

    Both come back as float32 then: bytes in [0, 1], or, where their numbers are wanted (raw), as
    they are.  Alpha is in [0, 1] in any case.
    """
    size = pixels.shape[1::-1] if max_side is None else reduced_size(pixels.shape[1::-1], max_side)
    if size == pixels.shape[1::-1]:
        return pixels, weights
    if not raw and pixels.dtype in (np.uint8, np.bool_):
        pixels = pixels / np.float32(255 if pixels.dtype == np.uint8 else 1)
    elif pixels.ndim == 3 and pixels.shape[2] == 4 and pixels.dtype.kind in "iu":
        alpha = pixels[..., 3:] / np.float32(np.iinfo(pixels.dtype).max)
        pixels = np.concatenate([pixels[..., :3], alpha], axis=-1, dtype=np.float32)
    return reduced(pixels, size, weights), None if weights is None else reduced(weights, size)


def _mean(values: Float32, size: tuple[int, int], weights: Pixels | None) -> Float32:
    """Weighted means of values (H, W) or (H, W, C); without weights plain ones."""
    if weights is None:
        return _by_channel(values, size)
    weights = weights.astype(np.float32)
    counted = weights if values.ndim == 2 else weights[..., None]
    sums = _by_channel(np.where(counted > 0, values, 0) * counted, size)
    total = _by_channel(weights, size)
    total = total if values.ndim == 2 else total[..., None]
    return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)


def _by_channel(values: Float32, size: tuple[int, int]) -> Float32:
    from PIL import Image

    planes = [values] if values.ndim == 2 else list(np.moveaxis(values, -1, 0))
    small = [
        np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize(size, Image.Resampling.BOX))
        for plane in planes
    ]
    return small[0] if values.ndim == 2 else np.stack(small, axis=-1)
