"""Converts and validates targets and renders.

Inside the library all images are *canonical*: C-contiguous float32 NumPy arrays with values in
[0, 1], `(H, W, 3)` for a target and `(n, H, W, 3)` for a batch.  The rules for all others:

- values: uint8 [0, 255] and bool are scaled to [0, 1]; floats keep their values; other types are
  refused, since their scale is unknown.  With a value range, [low, high] takes the place of [0, 1],
  and all types are numbers as they are; alpha is a share still;
- channels: none or 1, gray, repeated; 3, RGB; 4, RGBA, composited over white (a mask over black);
- axes: channels last.  In a torch tensor channels may come first: if the first axis has 1, 3 or 4
  entries and the other two fit the required size, if there is one;
- outside [0, 1]: refused in a target; clipped in a batch, with a warning, unless it is rounding (up
  to 1e-6).  Renders on another scale than the target are refused, see `pixels`;
- NaN and infinity are refused;
- hidden pixels, where a mask has zeros: NaN becomes 0, other values are clipped;
- files, PIL images: turned upright (EXIF), palettes expanded, 16 bits divided by 65535, grays of 32
  bits refused; of several frames the first, with a warning; at most `MAX_PIXELS` pixels.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.pixels import (
    Clip,
    OnClip,
    Pixels,
    Size,
    ValueRange,
    channels_last,
    check_axes,
    check_batch_axes,
    check_count,
    describe,
    extremes,
    from_tensor,
    is_path,
    is_pil,
    is_torch_tensor,
    is_unit,
    shares,
    typed,
    unit_range,
    warn_clipped,
)
from fide_plugins.validation.points import whole_number

__all__ = ["alpha_of", "as_batch", "as_target", "is_image", "load", "save", "warn_clipped"]


# -- public ----------------------------------------------------------------------------------------


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
    check_axes(array, what)
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
    on_clip: called once, with a `pixels.Clip`, if finite values outside [0, 1] were clipped.
    hidden, values: as of `as_target`.

    Raises ImageError (a ValueError) for wrong number, shape, type or values; a `ValueRangeError` if
    they are on another scale.
    """
    size = None if shape is None else (int(shape[0]), int(shape[1]))
    if isinstance(images, (list, tuple)):
        check_count(len(images), n)
        return _list_as_batch(images, size, on_clip, hidden, values)
    what = "the batch of images"
    if is_path(images) or is_pil(images):
        raise ImageError(f"{what} must be an (n, H, W, C) array or a list of images, got {images}")
    array, is_tensor = _to_array(images, what, values is not None)
    check_batch_axes(array, size, what)
    check_count(len(array), n)
    pixels: Pixels = channels_last(array, 1, is_tensor, size, what)
    is_float32 = pixels.dtype == np.float32 and pixels.shape[-1] == 3
    canonical = values is None and is_float32 and pixels.flags.c_contiguous
    if canonical and is_unit(*extremes(pixels)):
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


# -- steps: to an array, channels last, unit range, three channels ---------------------------------


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


def _to_array(image: object, what: str, raw: bool = False) -> tuple[Pixels, bool]:
    """Return the image as a numpy array, and whether it was a torch tensor."""
    if is_path(image) or is_pil(image):
        from fide_plugins.validation.image_files import from_pil, read_pixels  # rarely needed

        image = (
            read_pixels(os.fspath(image), None, raw=raw)  # type: ignore[call-overload]
            if is_path(image)
            else from_pil(image, what, raw=raw)
        )
    elif is_torch_tensor(image):
        return from_tensor(image, what, raw), True
    if np.ma.is_masked(image):
        raise ImageError(
            f"{what} is a masked array, and its mask would be lost; give image.filled(value), and "
            "say by mask= or weights= which pixels count"
        )
    if isinstance(image, list | tuple) and any(getattr(one, "ndim", 0) > 2 for one in image):
        raise ImageError(
            f"{what} must be one image, not a list of {len(image)}; give one of them, or for "
            "several views a target for each"
        )
    try:
        array = np.asarray(image)  # also of rows
    except (TypeError, ValueError, RuntimeError) as e:
        raise ImageError(f"{what} is not an image: {e}") from e
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
