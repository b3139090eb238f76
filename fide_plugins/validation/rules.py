"""Rules of axes and values that arrays and torch tensors of images share.

`pixels` below is an array or a tensor: only its shape, its dtype and views of it are used.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.validation.clipping import LIT, Clip, OnClip
from fide_plugins.validation.image_sources import describe
from fide_plugins.validation.value_range import ValueRange

__all__ = [
    "CHANNELS",
    "Size",
    "channels_last",
    "check_axes",
    "check_batch_axes",
    "check_count",
    "is_clipped",
    "refuse_not_finite",
]

Size: TypeAlias = tuple[int, int]  # (H, W)

CHANNELS = (1, 3, 4)  # gray, RGB, RGBA
ROUNDING = 1e-6
_LARGEST = 1e30  # of values that are added; there is no end to those of fireflies
_NO_FIT = "the image of"  # begins the name of a render that is no part of a fit


def check_axes(pixels: Any, what: str) -> None:
    """Raise ImageError unless the axes are those of one image."""
    if pixels.ndim not in (2, 3):
        remedy = ""
        if pixels.ndim == 4:
            remedy = f"; {_views('list(image)')}"
            if len(pixels) == 1:
                remedy = "; take it out of its batch of one, image[0]"
        raise ImageError(
            f"{what} must have axes (H, W) or (H, W, C), got {describe(pixels)}{remedy}"
        )


def _views(pictures: str) -> str:
    """What to write for several pictures in one array."""
    return f"of several pictures make views: {pictures}, a list, and let render return such a list"


def check_batch_axes(pixels: Any, size: Size | None, what: str) -> None:
    """Raise ImageError unless the axes are those of a batch."""
    single = pixels.ndim == 2 or (
        # (H, W, C) could pass for n gray images where no size tells them apart
        pixels.ndim == 3
        and pixels.shape[2] in CHANNELS
        and (size is None or tuple(pixels.shape[1:]) != size)
    )
    if single or pixels.ndim not in (3, 4):
        raise ImageError(
            f"{what} must have axes (n, H, W, C), or (n, H, W) for gray, got {describe(pixels)}"
            + ("; for a single image write image[None]" if single else "")
        )


def check_count(count: int, n: int | None) -> None:
    """Raise ImageError unless there are n images."""
    if n is not None and count != n:
        raise ImageError(f"there must be one image per point: got {count} images for {n} points")


def channels_last(
    pixels: Any,
    batch: int,
    may_be_first: bool,
    size: Size | None,
    what: str,
    remedy: str = "render at that size, or resize the target",
) -> Any:
    """View of `pixels` as (..., H, W, C), after `batch` (0 or 1) leading axes; checks the size.

    may_be_first: whether channels may come before H and W, as in torch tensors.
    remedy: for those of another size.
    """
    if pixels.ndim == batch + 2:
        pixels = pixels[..., None]
    else:
        first, *rest = pixels.shape[batch:]
        if may_be_first and first in CHANNELS and size in (None, tuple(rest)):
            pixels = pixels.swapaxes(batch, batch + 1).swapaxes(batch + 1, batch + 2)
        elif pixels.shape[-1] not in CHANNELS:
            count = pixels.shape[-1]
            each = f"[image[..., i] for i in range({count})]"
            hint = _views("list(image)" if first < count else each)
            if first in CHANNELS:
                hint = "np.moveaxis(image, -3, -1) puts the channels last"
            raise ImageError(
                f"{what} must have 1, 3 or 4 channels in its last axis, got {describe(pixels)}; "
                f"{hint}"
            )
    height, width = pixels.shape[batch : batch + 2]
    if height == 0 or width == 0:
        raise ImageError(f"{what} is empty: {describe(pixels)} has no pixels")
    if size is not None and size != (height, width):
        raise ImageError(
            f"{what} must have the target's size, {size[0]} x {size[1]} (H x W), got "
            f"{height} x {width}: {describe(pixels)}; {remedy}"
        )
    return pixels


def refuse_not_finite(what: str, bad: int, pixels: Any) -> ImageError:
    """Error for so many values that are NaN or infinite."""
    return ImageError(
        f"{what} must be finite, got {bad} NaN or infinite values in {describe(pixels)}; "
        "mend them in the renderer, or replace them with np.nan_to_num"
    )


def is_clipped(
    seen: Any,
    pixels: Any,
    low: float,
    high: float,
    what: str,
    on_clip: OnClip | None,
    values: ValueRange | None = None,
) -> bool:
    """Whether floats with these extremes are to be clipped to [0, 1]; `on_clip` None: never.

    seen: those of `pixels` that count; low, high: their extremes.
    values: range from which they were scaled, for messages; None: they are as they were given.

    Raises ImageError for those that are refused, ValueRangeError for renders that are plainly on
    another scale; tells `on_clip` of more than rounding.
    """
    if low >= 0.0 and high <= 1.0:
        return False
    if low >= -ROUNDING and high <= 1.0 + ROUNDING:
        return True
    ends = (low, high)
    if values is not None:
        ends = values.low + low * values.span, values.low + high * values.span
    of_bytes = values is None and _are_bytes(seen, low, high)
    got = f"values in [{ends[0]:.6g}, {ends[1]:.6g}], {describe(pixels)}"
    rule, remedy = values or "[0, 1]", _remedy(what, ends, of_bytes, values)
    if on_clip is None or of_bytes:
        refused = ImageError if on_clip is None else ValueRangeError
        raise refused(f"{what} must have values in {rule}, got {got}; {remedy}")
    hint = f"; if they are no overshoot, {remedy}" if high > 2.0 or low < -1.0 else ""
    batch = seen.reshape(len(pixels) if pixels.ndim == 4 else 1, -1)
    told = f"{what} has {got}; they are clipped to {rule}{hint}"
    on_clip(_clip(told, batch, ends))
    return True


def _clip(message: str, batch: Any, ends: tuple[float, float]) -> Clip:
    """What was clipped in images (n, values); ends: extremes in the user's values."""
    beyond = (batch > 1.0 + ROUNDING).any(1)
    outside = beyond | (batch < -ROUNDING).any(1)
    bright = batch[beyond]
    above = bright > 1.0
    total = bright[above].clip(0.0, _LARGEST).sum()
    counts = (int(outside.sum()), int((bright > LIT).sum()), int(above.sum()))
    return Clip(message, counts[0], *ends, *counts[1:], float(total))


def _are_bytes(seen: Any, low: float, high: float) -> bool:
    """Whether floats with these extremes are plainly in [0, 255]: whole numbers, one above 2."""
    if not (low >= 0.0 and 2.0 < high <= 255 + ROUNDING):
        return False
    return bool((seen == seen.round()).all())


def _remedy(what: str, ends: tuple[float, float], of_bytes: bool, values: ValueRange | None) -> str:
    """What to do about values with these extremes."""
    if what.startswith(("mask", "weights")):
        return "divide by 255" if of_bytes else "divide them by the largest"
    if values is not None:
        return "give a wider value_range, which target and renders share"
    if of_bytes:
        return "divide by 255, target and renders alike, or give value_range=(0, 255)"
    if what.startswith(_NO_FIT):
        return "divide all of them by the value that is white"
    given = f"value_range=({min(0.0, ends[0]):.6g}, {max(1.0, ends[1]):.6g})"
    clip = ", or clip what is an overshoot" if ends[0] >= -1.0 and ends[1] <= 2.0 else ""
    return (
        f'give {given} or "auto", in the shell --value-range, or divide target and renders by the '
        f"same number{clip}"
    )
