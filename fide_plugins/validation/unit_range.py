"""Values of arrays become floats in [0, 1]."""

from __future__ import annotations

import numpy as np

from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.types import Mask
from fide_plugins.validation.clipping import OnClip
from fide_plugins.validation.image_sources import Pixels, describe
from fide_plugins.validation.rules import ROUNDING, is_clipped, refuse_not_finite
from fide_plugins.validation.value_range import ValueRange

__all__ = ["extremes", "is_unit", "shares", "unit_range"]


def unit_range(
    pixels: Pixels,
    what: str,
    on_clip: OnClip | None,
    hidden: Mask | None = None,
    values: ValueRange | None = None,
) -> Pixels:
    """Values of (..., H, W, C) as floats in [0, 1], itself if they are; `on_clip` None: never clip.

    hidden: (H, W), pixels whose values are put into this range silently.
    """
    given = pixels
    if values is not None:
        _check_alpha(pixels, what, on_clip, hidden)
        pixels = _scaled(pixels, values)
    if pixels.dtype == np.uint8:
        return np.divide(pixels, np.float32(255), dtype=np.float32, order="C")
    if pixels.dtype == np.bool_:
        return pixels.astype(np.float32, order="C")
    low, high = extremes(pixels)
    if is_unit(low, high):
        return pixels
    seen = pixels
    if hidden is not None:  # what does not count is looked at only where something is wrong
        seen, pixels = pixels[..., ~hidden, :], _mended(pixels, hidden)
        low, high = extremes(seen)
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = seen.size - int(np.count_nonzero(np.isfinite(seen)))
        raise refuse_not_finite(what, bad, given)
    if seen.dtype.itemsize == 2:  # float16 counts and adds up to 65504 only
        seen = seen.astype(np.float32)
    if not is_clipped(seen, given, low, high, what, on_clip, values):
        return pixels
    return np.clip(pixels, 0.0, 1.0, order="C")


def _scaled(pixels: Pixels, values: ValueRange) -> Pixels:
    """Floats (..., C) of which [0, 1] is the value range, and the alpha channel has its own."""
    if pixels.shape[-1] != 4:
        return values.scaled(pixels)
    return np.concatenate([values.scaled(pixels[..., :3]), shares(pixels[..., 3:])], axis=-1)


def _check_alpha(pixels: Pixels, what: str, on_clip: OnClip | None, hidden: Mask | None) -> None:
    """Raise ImageError for an alpha channel of floats that are no shares; renders may overshoot."""
    if pixels.shape[-1] != 4 or pixels.dtype.kind != "f":
        return
    alpha = pixels[..., 3] if hidden is None else pixels[..., ~hidden, 3]
    low, high = extremes(alpha)
    most, refused = (ROUNDING, ImageError) if on_clip is None else (1.0, ValueRangeError)
    if low < -most or high > 1.0 + most:
        raise refused(
            f"{what} has an alpha channel with values in [{low:.6g}, {high:.6g}], "
            f"{describe(pixels)}; alpha of floats must be in [0, 1], whatever value_range is: "
            "divide it by its largest value, or leave it out, image[..., :3]"
        )


def shares(alpha: Pixels) -> Pixels:
    """An alpha channel in [0, 1] where it is one of whole numbers."""
    return alpha / np.iinfo(alpha.dtype).max if alpha.dtype.kind in "iu" else alpha


def _mended(pixels: Pixels, hidden: Mask) -> Pixels:
    """Copy of floats (..., H, W, C) whose hidden pixels lie in [0, 1], with 0 for NaN."""
    mended = pixels.copy(order="C")
    values = mended[..., hidden, :]
    values[np.isnan(values)] = 0.0
    mended[..., hidden, :] = np.clip(values, 0.0, 1.0)
    return mended


def extremes(pixels: Pixels) -> tuple[float, float]:
    """Smallest and largest value; NaN if there is one."""
    if pixels.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(pixels.min()), float(pixels.max())


def is_unit(low: float, high: float) -> bool:
    """Whether values from low to high lie in [0, 1]; False for NaN."""
    return low >= 0.0 and high <= 1.0
