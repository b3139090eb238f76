"""Converts targets and renders to C-contiguous float32 (H, W, 3) or (n, H, W, 3) in [0, 1].

uint8, bool, floats; gray is repeated, RGBA put over white (a mask over black); channels last, or
first in tensors.  Targets beyond [0, 1] and NaN are refused, renders clipped, see `values`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.points import whole_number
from fide_plugins.validation.values import (
    ROUNDING,
    Clip,
    OnClip,
    Pixels,
    ValueRange,
    describe,
    tell_clipped,
    typed,
    warn_clipped,
)

__all__ = ["alpha_of", "as_batch", "as_target", "is_image", "load", "save", "warn_clipped"]


Size: TypeAlias = tuple[int, int]  # (H, W)

CHANNELS = (1, 3, 4)  # gray, RGB, RGBA
_VIEWS = "of several pictures make views: list(image), and let render return such a list"


def as_target(
    target: object,
    *,
    what: str = "the target",
    size: Size | None = None,
    hidden: Mask | None = None,
    behind: float = 1.0,
    values: ValueRange | None = None,
) -> Float32:
    """Canonical copy of one image: float32 (H, W, 3) in [0, 1], C-contiguous.

    target: array, torch tensor, PIL image or path of an image file; see the module's rules.
    what: its name in errors.
    size: required size (H, W); None: any.
    hidden: (H, W), pixels that do not count; None: all do.
    behind: gray value in [0, 1] behind transparent pixels, 1 is white.
    values: those that become 0 and 1; None: 0 and 1.

    Raises ImageError (a ValueError) for wrong shape, type or values; `ImageNotFoundError` for a
    missing file.
    """
    pixels = as_pixels(target, what, values is not None, size)
    return _canonical(pixels, what, None, hidden, behind, values)


def as_pixels(image: object, what: str, raw: bool = False, size: Size | None = None) -> Pixels:
    """Array (H, W, C) of one image, with the values that it has; perhaps the image.

    what: its name in errors.  raw: whether any numbers will do, those of a file as it has them.
    size: required size (H, W); None: any.
    Raises ImageError for types and axes that no image has, `ImageNotFoundError`.
    """
    array, is_tensor = _to_array(image, what, raw)
    if array.ndim not in (2, 3):
        raise ImageError(
            f"{what} must have axes (H, W) or (H, W, C), got {describe(array)}; take an image out "
            f"of its batch, image[0]; {_VIEWS}"
        )
    pixels: Pixels = channels_last(array, 0, is_tensor, size, what)
    return pixels


def alpha_of(image: object, what: str = "the target") -> Float32:
    """Alpha channel (H, W) float32 in [0, 1] of `image`, any input of `as_target`.

    what: its name in errors.  Raises ImageError if it has none.
    """
    array = as_pixels(image, what, raw=True)  # a share, whatever values are white
    if array.shape[-1] != 4:
        raise ImageError(f"{what} must have an alpha channel, (H, W, 4), got {describe(array)}")
    alpha: Float32 = np.array(unit_range(shares(array[..., 3]), what, None), np.float32, order="C")
    return alpha


def is_image(value: object) -> bool:
    """Whether a value is meant as one picture: an array of two or more axes, a path, a PIL image.

    Its contents are not checked.
    """
    ndim = getattr(value, "ndim", 0)
    return is_path(value) or is_pil(value) or (not callable(ndim) and ndim >= 2)


def as_batch(
    images: object,
    shape: Sequence[int] | None = None,
    *,
    n: int | None = None,
    on_clip: OnClip = warn_clipped,
    hidden: Mask | None = None,
    values: ValueRange | None = None,
) -> Float32:
    """Canonical batch of images: float32 (n, H, W, 3) in [0, 1], C-contiguous.

    A canonical batch is checked and returned without a copy: do not modify the result, and keep
    no reference to it.

    images: (n, H, W) or (n, H, W, C) array or torch tensor, a torch tensor (n, C, H, W), or a list
        or tuple of images that `as_target` accepts.
    shape: required size (H, W), or shape (H, W, 3) of the target; None: that of the first image.
    n: required number of images; None: any number, also zero.
    on_clip: called once, with a `values.Clip`, if finite values outside [0, 1] were clipped.
    hidden, values: as of `as_target`.

    Raises ImageError (a ValueError) for wrong number, shape, type or values; a `ValueRangeError` if
    they are on another scale.
    """
    size = None if shape is None else (int(shape[0]), int(shape[1]))
    if isinstance(images, (list, tuple)):
        if n not in (None, len(images)):
            raise _miscounted(len(images), n)
        return _list_as_batch(images, size, on_clip, hidden, values)
    what = "the batch of images"
    array, is_tensor = _to_array(images, what, values is not None, batch=True)
    check_batch_axes(array, size, what)
    if n not in (None, len(array)):
        raise _miscounted(len(array), n)
    pixels: Pixels = channels_last(array, 1, is_tensor, size, what)
    is_float32 = pixels.dtype == np.float32 and pixels.shape[-1] == 3
    canonical = values is None and is_float32 and pixels.flags.c_contiguous
    if canonical:
        low, high = extremes(pixels)
        if low >= 0.0 and high <= 1.0:  # False for NaN
            return pixels
    return _canonical(pixels, what, on_clip, hidden, values=values)


def load(path: str | os.PathLike[str], *, max_side: int | None = None) -> Float32:
    """Canonical image (H, W, 3) float32 in [0, 1], read from the file `path`.

    max_side: a longer image is reduced by box averaging to at most so many pixels; None: not at
        all.

    Raises `ImageNotFoundError` or `ImageError`,
    OptionError for a `max_side` that is no whole number >= 1.
    """
    from fide_plugins.validation.image_files import read_pixels

    if max_side is not None:
        max_side = whole_number("max_side", max_side, 1)
    return as_target(read_pixels(path, max_side), what=repr(os.fspath(path)))


def save(path: str | os.PathLike[str], image: Float32) -> None:
    """Write an image (H, W), (H, W, 3) or (H, W, 4) to the file `path`, whose ending says how.

    .tif, .tiff: 32-bit floats, any values, without loss.  Other endings that Pillow writes, such as
    .png: 8 bits, values in [0, 1].

    Raises ImageError, before anything is written, for another ending, what is no image, NaN and
    infinity but in floats, and an alpha channel where the format has none; OSError if it cannot be
    written.
    """
    from fide_plugins.validation.image_files import encoded

    Path(path).write_bytes(encoded(image, Path(path).suffix))


def _list_as_batch(
    images: Sequence[object],
    size: Size | None,
    on_clip: OnClip,
    hidden: Mask | None,
    values: ValueRange | None,
) -> Float32:
    clipped: list[Clip] = []
    out: Float32 = np.empty((len(images), *(size or (0, 0)), 3), np.float32)
    for i, image in enumerate(images):
        if image is None:
            raise ImageError(
                f"image {i} is None; of a render that failed tell nothing: leave its point out, "
                f"and call withdraw(X[{i} : {i + 1}]), so that nobody waits for it"
            )
        what = f"image {i}"
        pixels = as_pixels(image, what, values is not None, size)
        rgb = _canonical(pixels, what, clipped.append, hidden, values=values)
        if size is None:
            size = (rgb.shape[0], rgb.shape[1])
            out = np.empty((len(images), *size, 3), np.float32)
        out[i] = rgb
    if clipped:
        on_clip(reduce(Clip.joined, clipped))
    return out


def _to_array(
    image: object, what: str, raw: bool = False, batch: bool = False
) -> tuple[Pixels, bool]:
    """Return the image as a numpy array, and whether it was a torch tensor; a file is no batch."""
    if type(image) is np.ndarray:
        plain = image.dtype == np.uint8 or image.dtype.kind in "fb"
        return (image if plain else typed(image, what, describe(image), raw)), False
    if is_torch_tensor(image):
        return from_tensor(image, what, raw), True
    if is_path(image) or is_pil(image):
        if batch:
            rule = "must be an (n, H, W, C) array or a list of images"
            raise ImageError(f"{what} {rule}, got {image}")
        from fide_plugins.validation.image_files import from_pil, read_pixels  # rarely needed

        image = (
            read_pixels(os.fspath(image), None, raw=raw)  # type: ignore[call-overload]
            if is_path(image)
            else from_pil(image, what, raw=raw)
        )
    if np.ma.is_masked(image):
        raise ImageError(
            f"{what} is a masked array, and its mask would be lost; give image.filled(value), and "
            "say by mask= or weights= which pixels count"
        )
    try:
        array = np.asarray(image)  # also of rows
    except (TypeError, ValueError, RuntimeError) as e:
        raise ImageError(f"{what} is not an image: {e}; give one array (H, W) or (H, W, C)") from e
    got = describe(array) if array.ndim else type(image).__name__
    return typed(array, what, got, raw), False


def _canonical(
    pixels: Pixels,
    what: str,
    on_clip: OnClip | None,
    hidden: Mask | None,
    behind: float = 1.0,
    values: ValueRange | None = None,
) -> Float32:
    """Canonical copy of (..., H, W, C): gray repeated, alpha composited over the gray `behind`."""
    unit = unit_range(pixels, what, on_clip, hidden, values)
    if unit.shape[-1] == 3 and unit.dtype == np.float32 and unit is not pixels:
        return unit  # a copy already
    out: Float32 = np.empty((*unit.shape[:-1], 3), np.float32)
    with np.errstate(under="ignore"):  # what is too small for float32 is 0
        if unit.shape[-1] == 4:
            alpha = unit[..., 3:].astype(np.float32)
            out[...] = behind - alpha * (behind - unit[..., :3].astype(np.float32))
        else:
            out[...] = unit
    return out


def check_batch_axes(pixels: Any, size: Size | None, what: str) -> None:
    """Raise ImageError unless the axes are those of a batch."""
    has_channels = pixels.ndim == 3 and pixels.shape[2] in CHANNELS  # as n gray images could
    single = pixels.ndim == 2 or (has_channels and tuple(pixels.shape[1:]) != size)
    if single or pixels.ndim not in (3, 4):
        raise ImageError(
            f"{what} must have axes (n, H, W, C), or (n, H, W) for gray, got {describe(pixels)}"
            + ("; for a single image write image[None]" if single else "")
        )


def _miscounted(count: int, n: int | None) -> ImageError:
    return ImageError(f"there must be one image per point: got {count} images for {n} points")


def channels_last(pixels: Any, batch: int, may_be_first: bool, size: Size | None, what: str) -> Any:
    """View of `pixels` as (..., H, W, C), after `batch` (0 or 1) axes; checks the size.

    may_be_first: whether channels may come before H and W, as in torch tensors.
    """
    if pixels.ndim == batch + 2:
        pixels = pixels[..., None]
    else:
        first, *rest = pixels.shape[batch:]
        if may_be_first and first in CHANNELS and size in (None, tuple(rest)):
            pixels = np.moveaxis(pixels, batch, -1)
        elif pixels.shape[-1] not in CHANNELS:
            move = "np.moveaxis(image, -3, -1) puts the channels last"
            raise ImageError(
                f"{what} must have 1, 3 or 4 channels in its last axis, got {describe(pixels)}; "
                f"{move if first in CHANNELS else _VIEWS}"
            )
    height, width = pixels.shape[batch : batch + 2]
    if height == 0 or width == 0:
        raise ImageError(f"{what} is empty: {describe(pixels)} has no pixels")
    if size is not None and size != (height, width):
        raise ImageError(
            f"{what} must have the target's size, {size[0]} x {size[1]} (H x W), got "
            f"{height} x {width}: {describe(pixels)}; give it that size"
        )
    return pixels


def is_path(image: object) -> bool:
    """Whether it names a file."""
    return isinstance(image, (str, os.PathLike))


def is_pil(image: object) -> bool:
    """Whether it is a PIL image."""
    module = sys.modules.get("PIL.Image")  # not imported: then nobody can have made one
    return module is not None and isinstance(image, module.Image)


def is_torch_tensor(image: object) -> bool:
    """Whether it is a torch tensor."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(image, torch.Tensor)


def from_tensor(tensor: Any, what: str, raw: bool = False) -> Pixels:
    """Array of a tensor on any device; ImageError for types that no image has, see `typed`."""
    try:
        tensor = tensor.detach().cpu()
        if tensor.dtype.is_floating_point and tensor.dtype.itemsize <= 2:
            tensor = tensor.float()  # numpy has no bfloat16
        array: Pixels = tensor.numpy()
    except (TypeError, RuntimeError, ValueError) as e:
        raise ImageError(f"{what}, a {tensor.dtype} tensor, is not an image: {e}") from e
    return typed(array, what, f"a tensor of {describe(array)}", raw)


def unit_range(
    pixels: Pixels,
    what: str,
    on_clip: OnClip | None,
    hidden: Mask | None = None,
    values: ValueRange | None = None,
) -> Pixels:
    """Values of (..., H, W, C) as floats in [0, 1], itself if they are; `on_clip` None: never clip.

    hidden: (H, W), pixels that are put into this range silently.
    """
    given = pixels
    if values is not None:
        pixels = _scaled(pixels, values)
    if pixels.dtype == np.uint8:
        return np.divide(pixels, np.float32(255), dtype=np.float32, order="C")
    if pixels.dtype == np.bool_:
        return pixels.astype(np.float32, order="C")
    low, high = extremes(pixels)
    if low >= 0.0 and high <= 1.0:  # False for NaN
        return pixels
    seen = pixels
    if hidden is not None:  # what does not count is looked at only where something is wrong
        seen, pixels = pixels[..., ~hidden, :], pixels.copy(order="C")
        pixels[..., hidden, :] = np.clip(np.nan_to_num(pixels[..., hidden, :]), 0.0, 1.0)
        low, high = extremes(seen)
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = seen.size - int(np.count_nonzero(np.isfinite(seen)))
        raise ImageError(
            f"{what} must be finite, got {bad} NaN or infinite values in {describe(given)}; "
            "mend them in the renderer, or replace them with np.nan_to_num"
        )
    if low >= 0.0 and high <= 1.0:
        return pixels
    if low < -ROUNDING or high > 1.0 + ROUNDING:
        wide = seen.astype(np.float32) if seen.dtype.itemsize == 2 else seen  # sums above 65504
        rows = wide.reshape(len(given) if given.ndim == 4 else 1, -1)
        tell_clipped(rows, (low, high), describe(given), what, on_clip, values)
    return np.clip(pixels, 0.0, 1.0, order="C")


def _scaled(pixels: Pixels, values: ValueRange) -> Pixels:
    """Floats (..., C) of which [0, 1] is the value range, and the alpha channel has its own."""
    if pixels.shape[-1] != 4:
        return values.scaled(pixels)
    return np.concatenate([values.scaled(pixels[..., :3]), shares(pixels[..., 3:])], axis=-1)


def shares(alpha: Pixels) -> Pixels:
    """An alpha channel in [0, 1] where it is one of whole numbers."""
    return alpha / np.iinfo(alpha.dtype).max if alpha.dtype.kind in "iu" else alpha


def extremes(pixels: Pixels) -> tuple[float, float]:
    """Smallest and largest value; NaN if there is one."""
    if pixels.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(pixels.min()), float(pixels.max())
