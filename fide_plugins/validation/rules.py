"""Rules of axes and values that arrays and torch tensors of images share.

`pixels` below is an array or a tensor: only its shape, its dtype and views of it are used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from fide_plugins.errors import ImageError
from fide_plugins.validation.image_sources import describe

__all__ = [
    "CHANNELS",
    "Size",
    "channels_last",
    "check_axes",
    "check_batch_axes",
    "check_count",
    "is_bright",
    "is_clipped",
    "refuse_not_finite",
]

Size: TypeAlias = tuple[int, int]  # (H, W)

CHANNELS = (1, 3, 4)  # gray, RGB, RGBA
ROUNDING = 1e-6
_BRIGHT = 8.0  # mean of floats in [0, 255]; of a render it would be eight times white


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


def is_bright(mean: float) -> bool:
    """Whether floats of that mean, up to 255, are plainly in [0, 255]."""
    return mean > _BRIGHT


def is_clipped(
    pixels: Any,
    low: float,
    high: float,
    of_bytes: Callable[[], bool],
    what: str,
    on_clip: Callable[[str], None] | None,
) -> bool:
    """Whether floats with these extremes are to be clipped to [0, 1]; `on_clip` None: never.

    of_bytes: whether values between 2 and 255 are plainly in [0, 255], see `is_bright`.

    Raises ImageError for those that are refused; tells `on_clip` of more than rounding.
    """
    if low >= 0.0 and high <= 1.0:
        return False
    if low < -ROUNDING or high > 1.0 + ROUNDING:
        hint = "; if they are in [0, 255], divide by 255" if high > 2.0 else ""
        values = f"values in [{low:.6g}, {high:.6g}], {describe(pixels)}"
        bytes_ = low >= 0 and 2 < high <= 255 + ROUNDING and of_bytes()
        if on_clip is None or bytes_:
            raise ImageError(f"{what} must have values in [0, 1], got {values}{hint or '; clip'}")
        on_clip(f"{what} has {values}; they are clipped to [0, 1]{hint}")
    return True
