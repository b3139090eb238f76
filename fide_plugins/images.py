"""The one place where targets and renders are converted and validated.

Inside the library an image has one form, called *canonical*: a C-contiguous float32 numpy array
with values in [0, 1], `(H, W, 3)` for a target and `(n, H, W, 3)` for a batch.  :func:`as_target`
and :func:`as_batch` bring everything else into it, by these rules.

=================  ============================================================================
values             uint8 [0, 255] and bool are scaled to [0, 1]; floats of any precision are
                   taken as they are; other types are refused, since their scale is not known
channels           none or 1: gray, repeated; 3: RGB; 4: RGBA, composited over white
axes               the channels come last.  A torch tensor may also have them first, and is
                   read so whenever its first axis has 1, 3 or 4 entries and the other two fit
                   the size that is asked for (that of the target), if one is
NaN, infinity      refused
outside [0, 1]     refused in a target; clipped in a batch, with a warning (a renderer may
                   overshoot).  An overshoot of up to 1e-6, which is rounding, is clipped silently
files, PIL images  turned upright (EXIF), palettes and 16-bit grays expanded, at most
                   `MAX_PIXELS` pixels
=================  ============================================================================

No torch and no Pillow is imported before an image needs it.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import DependencyError, ImageError, ImageNotFoundError

__all__ = ["MAX_PIXELS", "Float32", "as_batch", "as_target", "load", "warn_clipped"]

Float32: TypeAlias = npt.NDArray[np.float32]
Pixels: TypeAlias = npt.NDArray[Any]
Size: TypeAlias = tuple[int, int]  # (H, W)

MAX_PIXELS = 2**26
"""Most pixels an image file may decode to (67 megapixels, 0.8 GB as float32)."""

CHANNELS = (1, 3, 4)  # gray, RGB, RGBA
ROUNDING = 1e-6


# -- public ----------------------------------------------------------------------------------------


def as_target(target: object) -> Float32:
    """Canonical copy of one image.

    Parameters
    ----------
    target
        array, torch tensor, PIL image or path of an image file; see the module's rules.

    Returns
    -------
    float32 (H, W, 3) in [0, 1], C-contiguous, sharing no memory with `target`.

    Raises
    ------
    ImageError
        wrong shape, type or values (also a ValueError); `ImageNotFoundError` for a missing file.
    """
    return _as_image(target, None, "the target", on_clip=None)


def warn_clipped(message: str) -> None:
    """Issue a RuntimeWarning; the default of `as_batch(on_clip=...)`."""
    warnings.warn(message, RuntimeWarning, stacklevel=3)


def as_batch(
    images: object,
    shape: Sequence[int] | None = None,
    *,
    n: int | None = None,
    on_clip: Callable[[str], None] = warn_clipped,
) -> Float32:
    """Canonical batch of images.

    A batch that is canonical already is checked and returned as it is, not copied: read the
    result, do not write to it, and keep no reference to it.

    Parameters
    ----------
    images
        (n, H, W) or (n, H, W, C) array or torch tensor (there also (n, C, H, W)), or a list or
        tuple of whatever `as_target` takes.
    shape
        (H, W) that every image must have, or a target's (H, W, 3); None: that of the first image.
    n
        number of images that there must be; None: any, also zero.
    on_clip
        called once, with a message, if finite values outside [0, 1] had to be clipped.

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
        _check_count(len(images), n)
        return _list_as_batch(images, size, on_clip)
    what = "the batch of images"
    if _is_path(images) or _is_pil(images):
        raise ImageError(f"{what} must be an (n, H, W, C) array or a list of images, got {images}")
    array, is_tensor = _to_array(images, what)
    _check_batch_axes(array, size, what)
    _check_count(len(array), n)
    pixels = _channels_last(array, 1, is_tensor, size, what)
    if pixels.dtype == np.float32 and pixels.shape[-1] == 3 and pixels.flags.c_contiguous:
        low, high = _finite_range(pixels, what)
        if low >= 0.0 and high <= 1.0:
            return pixels
    return _canonical(pixels, what, on_clip)


def load(path: str | os.PathLike[str], *, max_side: int | None = None) -> Float32:
    """Canonical image read from a file, reduced to at most `max_side` pixels a side.

    Reduced by box averaging; an image that is small enough already is left as it is.  Raises
    `ImageNotFoundError` or `ImageError`.
    """
    return _as_image(_read(path, max_side), None, repr(os.fspath(path)), on_clip=None)


# -- steps: to an array, channels last, unit range, three channels ---------------------------------


def _as_image(
    image: object, size: Size | None, what: str, on_clip: Callable[[str], None] | None
) -> Float32:
    array, is_tensor = _to_array(image, what)
    if array.ndim not in (2, 3):
        raise ImageError(f"{what} must have axes (H, W) or (H, W, C), got {_describe(array)}")
    return _canonical(_channels_last(array, 0, is_tensor, size, what), what, on_clip)


def _list_as_batch(
    images: Sequence[object], size: Size | None, on_clip: Callable[[str], None]
) -> Float32:
    clipped: list[str] = []
    out: Float32 = np.empty((len(images), *(size or (0, 0)), 3), np.float32)
    for i, image in enumerate(images):
        rgb = _as_image(image, size, f"image {i}", clipped.append)
        if size is None:
            size = (rgb.shape[0], rgb.shape[1])
            out = np.empty((len(images), *size, 3), np.float32)
        out[i] = rgb
    if clipped:
        more = f" (and {len(clipped) - 1} more images)" if len(clipped) > 1 else ""
        on_clip(clipped[0] + more)
    return out


def _to_array(image: object, what: str) -> tuple[Pixels, bool]:
    """Return the image as a numpy array, and whether it was a torch tensor."""
    if _is_path(image):
        image = _read(os.fspath(image), None)  # type: ignore[call-overload]
    elif _is_pil(image):
        image = _from_pil(image, what)
    elif _is_tensor(image):
        return _from_tensor(image, what), True
    try:
        array = np.asarray(image)
    except (TypeError, ValueError, RuntimeError) as e:
        raise ImageError(f"{what} is not an image: {e}") from e
    if array.dtype.kind not in "fb" and array.dtype != np.uint8:
        raise ImageError(
            f"{what} must be uint8 in [0, 255], bool, or floating in [0, 1], got "
            f"{_describe(array) if array.ndim else type(image).__name__}; convert it, for example "
            "image.astype(np.uint8) if its values are in [0, 255]"
        )
    return array, False


def _channels_last(
    array: Pixels, batch: int, is_tensor: bool, size: Size | None, what: str
) -> Pixels:
    """View of `array` as (..., H, W, C), after `batch` (0 or 1) leading axes; checks the size."""
    if array.ndim == batch + 2:
        array = array[..., None]
    else:
        first, *rest = array.shape[batch:]
        if is_tensor and first in CHANNELS and size in (None, tuple(rest)):
            array = np.moveaxis(array, batch, -1)
        elif array.shape[-1] not in CHANNELS:
            remedy = "; np.moveaxis(image, -3, -1) puts the channels last"
            raise ImageError(
                f"{what} must have 1, 3 or 4 channels in its last axis, got "
                f"{_describe(array)}{remedy if first in CHANNELS else ''}"
            )
    height, width = array.shape[batch : batch + 2]
    if height == 0 or width == 0:
        raise ImageError(f"{what} is empty: {_describe(array)} has no pixels")
    if size is not None and size != (height, width):
        raise ImageError(
            f"{what} must have the target's size, {size[0]} x {size[1]} (H x W), got "
            f"{height} x {width}: {_describe(array)}; render at that size, or resize the target"
        )
    return array


def _canonical(pixels: Pixels, what: str, on_clip: Callable[[str], None] | None) -> Float32:
    """Canonical copy of (..., C): gray repeated, alpha composited over white."""
    values = _unit_range(pixels, what, on_clip)
    if values.shape[-1] == 3 and values.dtype == np.float32 and values is not pixels:
        return values  # a copy already
    out: Float32 = np.empty((*values.shape[:-1], 3), np.float32)
    if values.shape[-1] == 4:
        alpha = values[..., 3:].astype(np.float32)
        out[...] = 1.0 - alpha * (1.0 - values[..., :3].astype(np.float32))
    else:
        out[...] = values
    return out


def _unit_range(pixels: Pixels, what: str, on_clip: Callable[[str], None] | None) -> Pixels:
    """Values of (..., C) as floats in [0, 1], itself if they are; `on_clip` None: never clip."""
    if pixels.dtype == np.uint8:
        return np.divide(pixels, np.float32(255), dtype=np.float32, order="C")
    if pixels.dtype == np.bool_:
        return pixels.astype(np.float32, order="C")
    low, high = _finite_range(pixels, what)
    if low >= 0.0 and high <= 1.0:
        return pixels
    if low < -ROUNDING or high > 1.0 + ROUNDING:
        hint = "; if they are in [0, 255], divide by 255" if high > 2.0 else ""
        values = f"values in [{low:.6g}, {high:.6g}], {_describe(pixels)}"
        if on_clip is None:
            raise ImageError(f"{what} must have values in [0, 1], got {values}{hint or '; clip'}")
        on_clip(f"{what} has {values}; they are clipped to [0, 1]{hint}")
    return np.clip(pixels, 0.0, 1.0, order="C")


# -- checks ----------------------------------------------------------------------------------------


def _describe(array: Pixels) -> str:
    return f"shape {array.shape}, dtype {array.dtype}"


def _finite_range(pixels: Pixels, what: str) -> tuple[float, float]:
    """Smallest and largest value; NaN and infinity, which show up in these two, are refused."""
    if pixels.size == 0:
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        low, high = float(pixels.min()), float(pixels.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = pixels.size - int(np.count_nonzero(np.isfinite(pixels)))
        raise ImageError(
            f"{what} must be finite, got {bad} NaN or infinite values in {_describe(pixels)}; "
            "mend them in the renderer, or replace them with np.nan_to_num"
        )
    return low, high


def _check_batch_axes(array: Pixels, size: Size | None, what: str) -> None:
    single = array.ndim == 2 or (
        # (H, W, C) could pass for n gray images where no size tells them apart
        array.ndim == 3 and array.shape[2] in CHANNELS and (size is None or array.shape[1:] != size)
    )
    if single or array.ndim not in (3, 4):
        raise ImageError(
            f"{what} must have axes (n, H, W, C), or (n, H, W) for gray, got {_describe(array)}"
            + ("; for a single image write image[None]" if single else "")
        )


def _check_count(count: int, n: int | None) -> None:
    if n is not None and count != n:
        raise ImageError(f"there must be one image per point: got {count} images for {n} points")


# -- sources ---------------------------------------------------------------------------------------


def _is_path(image: object) -> bool:
    return isinstance(image, (str, os.PathLike))


def _is_pil(image: object) -> bool:
    module = sys.modules.get("PIL.Image")  # not imported: then nobody can have made one
    return module is not None and isinstance(image, module.Image)


def _is_tensor(image: object) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(image, torch.Tensor)


def _from_tensor(tensor: Any, what: str) -> Pixels:
    try:
        tensor = tensor.detach().cpu()
        if tensor.dtype.is_floating_point and tensor.dtype.itemsize <= 2:
            tensor = tensor.float()  # numpy has no bfloat16
        array: Pixels = tensor.numpy()
    except (TypeError, RuntimeError, ValueError) as e:
        raise ImageError(f"{what}, a {tensor.dtype} tensor, is not an image: {e}") from e
    if array.dtype.kind not in "fb" and array.dtype != np.uint8:
        raise ImageError(
            f"{what} must be uint8 in [0, 255], bool, or floating in [0, 1], got a tensor of "
            f"{_describe(array)}; write image.to(torch.uint8) if its values are in [0, 255]"
        )
    return array


def _read(path: str | os.PathLike[str], max_side: int | None) -> Pixels:
    """Decode an image file; the size in its header is checked before any pixel is."""
    try:
        from PIL import Image
    except ImportError as e:
        raise DependencyError("reading an image file needs Pillow: pip install pillow") from e
    try:
        with Image.open(path) as image:
            if max_side is not None:
                image.draft(None, (max_side, max_side))  # JPEG: decode at a fraction of its size
            return _from_pil(image, repr(os.fspath(path)), max_side)
    except FileNotFoundError as e:
        raise ImageNotFoundError(f"no image file at {os.fspath(path)!r}") from e
    except ImageError:
        raise
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        raise ImageError(f"cannot read {os.fspath(path)!r} as an image: {e}") from e


def _from_pil(image: Any, what: str, max_side: int | None = None) -> Pixels:
    from PIL import Image, ImageOps

    width, height = image.size
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{what} has {width} x {height} pixels, more than {MAX_PIXELS:,}; reduce it first"
        )
    image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I"):  # 16-bit gray, which Pillow keeps in 32 bits for some formats
        image = Image.fromarray(np.asarray(image, np.float32) / np.float32(65535))
    elif image.has_transparency_data:
        image = image.convert("RGBA")
    elif image.mode not in ("F", "1"):
        image = image.convert("RGB")
    if max_side is not None and max(image.size) > max_side:
        scale = max_side / max(image.size)
        small = [max(1, round(side * scale)) for side in image.size]
        image = image.convert("L" if image.mode == "1" else image.mode)
        image = image.resize((small[0], small[1]), Image.Resampling.BOX)
    return np.asarray(image)
