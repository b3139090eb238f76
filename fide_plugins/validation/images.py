"""Converts and validates targets and renders.

Inside the library all images are *canonical*: C-contiguous float32 NumPy arrays with values in
[0, 1], `(H, W, 3)` for a target and `(n, H, W, 3)` for a batch.  :func:`as_target` and
:func:`as_batch` convert all other images by these rules.

=================  ============================================================================
values             uint8 [0, 255] and bool are scaled to [0, 1]; floats of any precision keep
                   their values; other types are refused, since their scale is unknown: white may
                   be 4095 in a uint16 array
channels           none or 1: gray, repeated; 3: RGB; 4: RGBA, composited over white (a mask over
                   black: what is transparent is hidden)
axes               channels last.  In a torch tensor channels may come first: if the first axis
                   has 1, 3 or 4 entries and the other two fit the required size (that of the
                   target), if there is one
NaN, infinity      refused
outside [0, 1]     refused in a target; clipped in a batch, with a warning (a renderer may
                   overshoot).  An overshoot of up to 1e-6, which is rounding, is clipped silently.
                   Floats that are plainly in [0, 255] are refused: up to 255, above 2, and all of
                   them whole numbers or their mean above 8
hidden pixels      where a mask has zeros: NaN becomes 0, other values are clipped, and nothing is
                   refused for them
files, PIL images  turned upright (EXIF), palettes expanded, 16-bit grays divided by 65535, those
                   of 32 bits refused; of several frames the first, with a warning; at most
                   `MAX_PIXELS` pixels
=================  ============================================================================

PyTorch and Pillow are imported only if an image needs them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.runtime.warn import warn_user
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.image_sources import (
    MAX_PIXELS,
    Pixels,
    describe,
    from_pil,
    from_tensor,
    has_scale,
    is_path,
    is_pil,
    is_torch_tensor,
    read_pixels,
    refuse_type,
    scale_remedy,
    unmasked,
)
from fide_plugins.validation.points import whole_number
from fide_plugins.validation.rules import (
    CHANNELS,
    Size,
    channels_last,
    check_axes,
    check_batch_axes,
    check_count,
    is_bright,
    is_clipped,
    refuse_not_finite,
)

__all__ = [
    "MAX_PIXELS",
    "alpha_of",
    "as_batch",
    "as_target",
    "is_image",
    "load",
    "warn_clipped",
]


# -- public ----------------------------------------------------------------------------------------


def as_target(
    target: object,
    *,
    what: str = "the target",
    size: Size | None = None,
    hidden: Mask | None = None,
    behind: float = 1.0,
) -> Float32:
    """Canonical copy of one image.

    Parameters
    ----------
    target
        array, torch tensor, PIL image or path of an image file; see the module's rules.
    what
        its name in errors.
    size
        required size (H, W); None: any.
    hidden
        (H, W), pixels that do not count; None: all do.
    behind
        gray value in [0, 1] behind transparent pixels, 1 is white.

    Returns
    -------
    float32 (H, W, 3) in [0, 1], C-contiguous, sharing no memory with `target`.

    Raises
    ------
    ImageError
        wrong shape, type or values (also a ValueError); `ImageNotFoundError` for a missing file.
    """
    pixels = _pixels(target, size, what, "resize it to that")
    return _canonical(pixels, what, None, hidden, behind)


def as_pixels(image: object, what: str) -> Pixels:
    """Array (H, W) or (H, W, C) of one image, with the values that it has; perhaps the image.

    what: its name in errors.

    Raises ImageError for types and axes that no image has, `ImageNotFoundError`.
    """
    array, is_tensor = _to_array(image, what)
    check_axes(array, what)
    if array.ndim == 2:
        return array
    pixels: Pixels = channels_last(array, 0, is_tensor, None, what)
    return pixels


def alpha_of(image: object, what: str = "the target") -> Float32:
    """Alpha channel (H, W) float32 in [0, 1] of `image`, any input of `as_target`.

    what: how an error calls it.

    Raises ImageError if it has none.
    """
    array, is_tensor = _to_array(image, what)
    if array.ndim == 3:
        array = channels_last(array, 0, is_tensor, None, what)
    if array.ndim != 3 or array.shape[-1] != 4:
        raise ImageError(f"{what} must have an alpha channel, (H, W, 4), got {describe(array)}")
    alpha: Float32 = np.array(_unit_range(array[..., 3], what, None), np.float32, order="C")
    return alpha


def is_image(value: object) -> bool:
    """Whether a value is meant as one picture: an array of two or more axes, a path, a PIL image.

    Its contents are not checked.
    """
    ndim = getattr(value, "ndim", 0)
    return is_path(value) or is_pil(value) or (not callable(ndim) and ndim >= 2)


def warn_clipped(message: str) -> None:
    """Issue `message` as a RuntimeWarning; the default of `as_batch(on_clip=...)`."""
    warn_user(message)


def as_batch(
    images: object,
    shape: Sequence[int] | None = None,
    *,
    n: int | None = None,
    on_clip: Callable[[str], None] = warn_clipped,
    hidden: Mask | None = None,
) -> Float32:
    """Canonical batch of images.

    A canonical batch is checked and returned without a copy: do not modify the result, and keep
    no reference to it.

    Parameters
    ----------
    images
        (n, H, W) or (n, H, W, C) array or torch tensor, a torch tensor (n, C, H, W), or a list or
        tuple of images that `as_target` accepts.
    shape
        required size (H, W), or shape (H, W, 3) of the target; None: that of the first image.
    n
        required number of images; None: any number, also zero.
    on_clip
        called once, with a message, if finite values outside [0, 1] were clipped.
    hidden
        (H, W) of that shape, pixels that do not count; None: all do.

    Returns
    -------
    float32 (n, H, W, 3) in [0, 1], C-contiguous.

    Raises
    ------
    ImageError
        wrong number, shape, type or values (also a ValueError).
    """
    size = None if shape is None else (int(shape[0]), int(shape[1]))
    if isinstance(images, (list, tuple)):
        check_count(len(images), n)
        return _list_as_batch(images, size, on_clip, hidden)
    what = "the batch of images"
    if is_path(images) or is_pil(images):
        raise ImageError(f"{what} must be an (n, H, W, C) array or a list of images, got {images}")
    array, is_tensor = _to_array(images, what)
    check_batch_axes(array, size, what)
    check_count(len(array), n)
    pixels: Pixels = channels_last(array, 1, is_tensor, size, what)
    is_float32 = pixels.dtype == np.float32 and pixels.shape[-1] == 3
    if is_float32 and pixels.flags.c_contiguous and _is_unit(*_extremes(pixels)):
        return pixels
    return _canonical(pixels, what, on_clip, hidden)


def load(path: str | os.PathLike[str], *, max_side: int | None = None) -> Float32:
    """Canonical image (H, W, 3) float32 in [0, 1], read from the file `path`.

    max_side: the image is reduced by box averaging to at most so many pixels; None: not at all.

    An image whose longer side fits is not resized.  Raises `ImageNotFoundError` or `ImageError`,
    OptionError for a `max_side` that is no whole number >= 1.
    """
    if max_side is not None:
        max_side = whole_number("max_side", max_side, 1)
    return as_target(read_pixels(path, max_side), what=repr(os.fspath(path)))


# -- steps: to an array, channels last, unit range, three channels ---------------------------------


def _pixels(image: object, size: Size | None, what: str, *remedy: str) -> Pixels:
    """Pixels (H, W, C) of one image, with the values that it has; remedy: for another size."""
    array, is_tensor = _to_array(image, what)
    check_axes(array, what)
    pixels: Pixels = channels_last(array, 0, is_tensor, size, what, *remedy)
    return pixels


def _list_as_batch(
    images: Sequence[object],
    size: Size | None,
    on_clip: Callable[[str], None],
    hidden: Mask | None,
) -> Float32:
    clipped: list[str] = []
    out: Float32 = np.empty((len(images), *(size or (0, 0)), 3), np.float32)
    for i, image in enumerate(images):
        if image is None:
            raise ImageError(
                f"image {i} is None; of a render that failed tell nothing: leave its point out, "
                f"and call withdraw(X[{i} : {i + 1}]), so that nobody waits for it"
            )
        what = f"image {i}"
        rgb = _canonical(_pixels(image, size, what), what, clipped.append, hidden)
        if size is None:
            size = (rgb.shape[0], rgb.shape[1])
            out = np.empty((len(images), *size, 3), np.float32)
        out[i] = rgb
    if clipped:
        more = f" (and {len(clipped) - 1} more images)" if len(clipped) > 1 else ""
        on_clip(clipped[0] + more)
    return out


def _check_one(image: object, what: str) -> None:
    """Raise ImageError for a list of images; one image may be a list of its rows, (W, C) each."""
    listed = isinstance(image, list | tuple)
    if not listed or not any(is_image(one) and not _is_row(one) for one in image):  # type: ignore[attr-defined]
        return
    number = len(image)  # type: ignore[arg-type]
    remedy = "give one of them, or for several views a target for each"
    if number == 1:
        remedy = "take it out of its list, image[0]"
    raise ImageError(f"{what} must be one image, not a list of {number}; {remedy}")


def _is_row(image: object) -> bool:
    """Whether what is an image by itself may be a row (W, C) of another one."""
    shape: tuple[int, ...] = getattr(image, "shape", ())
    return len(shape) == 2 and shape[1] in CHANNELS


def _to_array(image: object, what: str) -> tuple[Pixels, bool]:
    """Return the image as a numpy array, and whether it was a torch tensor."""
    if is_path(image):
        image = read_pixels(os.fspath(image), None)  # type: ignore[call-overload]
    elif is_pil(image):
        image = from_pil(image, what)
    elif is_torch_tensor(image):
        return from_tensor(image, what), True
    if isinstance(image, np.ma.MaskedArray):
        image = unmasked(image, what)
    _check_one(image, what)
    try:
        array = np.asarray(image)
    except (TypeError, ValueError, RuntimeError) as e:
        raise ImageError(f"{what} is not an image: {e}") from e
    if not array.ndim and not has_scale(array):
        remedy = "give an array, a path, a PIL image or a torch tensor"
        raise refuse_type(what, type(image).__name__, remedy)
    if not has_scale(array):
        name = "image" if isinstance(image, np.ndarray) else "np.asarray(image)"
        remedy = scale_remedy(array, f"{name}.astype(bool)", f"{name}.astype(np.uint8)")
        raise refuse_type(what, describe(array), remedy)
    return array, False


def _canonical(
    pixels: Pixels,
    what: str,
    on_clip: Callable[[str], None] | None,
    hidden: Mask | None,
    behind: float = 1.0,
) -> Float32:
    """Canonical copy of (..., H, W, C): gray repeated, alpha composited over the gray `behind`."""
    values = _unit_range(pixels, what, on_clip, hidden)
    if values.shape[-1] == 3 and values.dtype == np.float32 and values is not pixels:
        return values  # a copy already
    out: Float32 = np.empty((*values.shape[:-1], 3), np.float32)
    with np.errstate(under="ignore"):  # what is too small for float32 is 0
        if values.shape[-1] == 4:
            alpha = values[..., 3:].astype(np.float32)
            out[...] = behind - alpha * (behind - values[..., :3].astype(np.float32))
        else:
            out[...] = values
    return out


def _unit_range(
    pixels: Pixels,
    what: str,
    on_clip: Callable[[str], None] | None,
    hidden: Mask | None = None,
) -> Pixels:
    """Values of (..., H, W, C) as floats in [0, 1], itself if they are; `on_clip` None: never clip.

    hidden: (H, W), pixels whose values are put into this range silently.
    """
    if pixels.dtype == np.uint8:
        return np.divide(pixels, np.float32(255), dtype=np.float32, order="C")
    if pixels.dtype == np.bool_:
        return pixels.astype(np.float32, order="C")
    low, high = _extremes(pixels)
    if _is_unit(low, high):
        return pixels
    seen = pixels
    if hidden is not None:  # what does not count is looked at only where something is wrong
        seen, pixels = pixels[..., ~hidden, :], _mended(pixels, hidden)
        low, high = _extremes(seen)
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = seen.size - int(np.count_nonzero(np.isfinite(seen)))
        raise refuse_not_finite(what, bad, pixels)

    def of_bytes() -> bool:
        return is_bright(seen.mean(dtype=np.float64)) or bool((seen == np.rint(seen)).all())

    if not is_clipped(pixels, low, high, of_bytes, what, on_clip):
        return pixels
    return np.clip(pixels, 0.0, 1.0, order="C")


def _mended(pixels: Pixels, hidden: Mask) -> Pixels:
    """Copy of floats (..., H, W, C) whose hidden pixels lie in [0, 1], with 0 for NaN."""
    mended = pixels.copy(order="C")
    values = mended[..., hidden, :]
    values[np.isnan(values)] = 0.0
    mended[..., hidden, :] = np.clip(values, 0.0, 1.0)
    return mended


def _extremes(pixels: Pixels) -> tuple[float, float]:
    """Smallest and largest value; NaN if there is one."""
    if pixels.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        return float(pixels.min()), float(pixels.max())


def _is_unit(low: float, high: float) -> bool:
    """Whether values from low to high lie in [0, 1]; False for NaN."""
    return low >= 0.0 and high <= 1.0
