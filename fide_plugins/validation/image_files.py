"""Pixels of image files and PIL images, and image files of pixels.

Pillow reads most files.  OpenCV reads those that Pillow cannot: TIFF of float colors, Radiance HDR,
colors of 16 bits where their numbers matter.  The extra exr reads EXR (`exr`).
"""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from fide_plugins.errors import DependencyError, ImageError, ImageNotFoundError
from fide_plugins.runtime.files import RefusedFileError, check_regular
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32
from fide_plugins.validation import exr
from fide_plugins.validation.image_sources import Pixels, refuse_type, scale_remedy
from fide_plugins.validation.reduction import reduced, reduced_size

__all__ = ["MAX_PIXELS", "encoded", "from_pil", "read_pixels", "save"]

MAX_PIXELS = 2**26
"""Most pixels an image file may decode to (67 megapixels, 0.8 GB as float32)."""
_WIDENED = ("PNG", "PPM")  # formats of 16 bits, which Pillow may keep in 32
_TIFF = (".tif", ".tiff")  # Pillow reads floats of gray ones only
_LAYERED = ("MPO", "PSD")  # their first frame is the picture, the others belong to it
_OPENCV = (*_TIFF, ".hdr")
_EXR = ".exr"
_ORIENTATION = 0x0112  # EXIF


def read_pixels(path: str | os.PathLike[str], max_side: int | None, *, raw: bool = False) -> Pixels:
    """Decode an image file; the size in its header is checked before any pixel is.

    raw: numbers as they are stored; otherwise those of 16 bits are divided by 65535.
    """
    try:
        from PIL import Image
    except ImportError as e:
        raise DependencyError("reading an image file needs Pillow: pip install pillow") from e
    try:
        check_regular(path)
        with Image.open(path) as image:
            frames = 1 if image.format in _LAYERED else getattr(image, "n_frames", 1)
            whole = image.size
            if max_side is not None:
                image.draft(None, (max_side, max_side))  # JPEG: decode at a fraction of its size
            if _narrowed(image):
                pixels = _of_16_bit_colors(image, path, max_side, raw)
            else:
                pixels = from_pil(image, repr(os.fspath(path)), max_side, whole, raw=raw)
    except FileNotFoundError as e:
        raise ImageNotFoundError(f"no image file at {os.fspath(path)!r}") from e
    except ImageError:
        raise
    except RefusedFileError as e:
        raise ImageError(f"{e} with an image") from e
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        return _of_another_format(path, max_side, raw, e)
    if frames > 1:
        name = os.path.basename(os.fspath(path))
        warn_user(f"{name} has {frames} frames or pages, of which the first one is taken")
    return pixels


def _narrowed(image: Any) -> bool:
    """Whether Pillow reads colors of 16 bits of this file as 8 bits."""
    return image.mode in ("RGB", "RGBA") and any(
        ";16" in str(tile[3]) or (tile[0] == "ppm" and tile[3][1:] == (65535,))
        for tile in image.tile
    )


def _of_16_bit_colors(
    image: Any, path: str | os.PathLike[str], max_side: int | None, raw: bool
) -> Pixels:
    """Colors with all of their bits, upright; `image` is the file as Pillow has opened it."""
    pixels = _by_opencv(path, max_side)
    if not raw and pixels.dtype != np.uint8:  # floats where they have been reduced
        pixels = pixels / np.float32(65535)
    return _upright(pixels, image.getexif().get(_ORIENTATION, 1))


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """Pixels (H, W, C) turned by the number that EXIF has for it."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _of_another_format(
    path: str | os.PathLike[str], max_side: int | None, raw: bool, error: Exception
) -> Pixels:
    """Decode by OpenCV or OpenEXR what Pillow cannot; raises ImageError, DependencyError."""
    name = os.fspath(path)
    remedy = "is it whole, and is it an image? PNG, JPEG, TIFF, PPM, HDR and EXR can be read"
    if name.lower().endswith(_EXR):
        return _at_most(exr.decoded(path, MAX_PIXELS), max_side)
    if name.lower().endswith(_OPENCV):
        try:
            pixels = _by_opencv(path, max_side)
        except ImageError:
            raise
        except Exception as e:  # of a header that is none
            error = e
        else:
            if raw or pixels.dtype.kind == "f":
                return pixels
            return pixels if pixels.dtype == np.uint8 else pixels / np.float32(65535)
    raise ImageError(f"cannot read {name!r} as an image: {error}; {remedy}") from error


def _by_opencv(path: str | os.PathLike[str], max_side: int | None) -> Pixels:
    """Pixels (H, W) or (H, W, C) of a file, with the numbers that it has; raises ImageError."""
    from fide_plugins.runtime.opencv import cv2  # takes a while

    name = os.fspath(path)
    width, height = _size_in_header(Path(path))
    _check_size(width, height, repr(name))
    pixels = cv2.imread(name, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise ImageError(f"cannot read {name!r} as an image: is it whole? Save it as TIFF or PNG")
    if pixels.ndim == 3:  # BGR, BGRA
        order = [2, 1, 0, 3][: pixels.shape[2]] if pixels.shape[2] in (3, 4) else slice(None)
        pixels = np.ascontiguousarray(pixels[..., order])
    return _at_most(pixels, max_side)


def _at_most(pixels: Pixels, max_side: int | None) -> Pixels:
    """The picture with at most so many pixels a side."""
    size = None if max_side is None else reduced_size(pixels.shape[1::-1], max_side)
    return pixels if size in (None, pixels.shape[1::-1]) else reduced(pixels, size)


def _size_in_header(path: Path) -> tuple[int, int]:
    """Width and height of a TIFF, HDR or PNG file; raises whatever a wrong header causes."""
    from PIL import Image, TiffImagePlugin

    if path.suffix.lower() in _TIFF:
        with path.open("rb") as file:
            header = file.read(8)
            header += file.read(8) if 43 in header[2:4] else b""  # of a BigTIFF
            directory = TiffImagePlugin.ImageFileDirectory_v2(header)
            file.seek(directory.next)
            directory.load(file)
        return int(directory[256]), int(directory[257])
    if path.suffix.lower() == ".hdr":
        with path.open("rb") as file:
            found = re.search(rb"[-+]Y (\d+) [-+]X (\d+)", file.read(2**16))
        if found is None:
            raise ValueError("its header has no size")
        return int(found[2]), int(found[1])
    with Image.open(path) as image:
        width, height = image.size
    return width, height


def _check_size(width: int, height: int, what: str) -> None:
    """Raise ImageError for too many pixels."""
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{what} has {width} x {height} pixels, more than {MAX_PIXELS:,}; reduce it first"
        )


def from_pil(
    image: Any,
    what: str,
    max_side: int | None = None,
    whole: tuple[int, int] | None = None,
    *,
    raw: bool = False,
) -> Pixels:
    """Array of a PIL image, turned upright, with at most `max_side` pixels a side; ImageError.

    whole: width and height of the picture of which the image is a rough reduction; None: its own.
    raw: see `read_pixels`.
    """
    from PIL import Image, ImageOps

    width, height = image.size
    _check_size(width, height, what)
    form, whole = image.format, whole or image.size
    image = ImageOps.exif_transpose(image)
    if image.size != (width, height):
        whole = whole[::-1]
    size = whole if max_side is None else reduced_size(whole, max_side)
    if image.mode.startswith("I") and raw:
        return reduced(np.asarray(image), size)
    if image.mode.startswith("I"):
        _check_16_bits(image, form, what)
        return _of_16_bits(image, size)
    if image.has_transparency_data:
        image = image.convert("RGBA")
    elif image.mode not in ("F", "1"):
        image = image.convert("RGB")
    if image.size != size:
        image = image.convert("L" if image.mode == "1" else image.mode)
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image)


def _check_16_bits(image: Any, form: str | None, what: str) -> None:
    """Raise ImageError for whole numbers of 32 bits, whose white is unknown."""
    if image.mode.startswith("I;16") or form in _WIDENED:
        return
    remedy = scale_remedy(
        np.asarray(image), "np.asarray(image).astype(bool)", "np.asarray(image).astype(np.uint8)"
    )
    got = f"whole numbers of 32 bits (Pillow's mode {image.mode!r})"
    raise refuse_type(what, got, f"{remedy}, or save the picture with 8 or 16 bits")


def _of_16_bits(image: Any, size: tuple[int, int]) -> Pixels:
    """Gray (H, W) in [0, 1] of 16 bits; (H, W, 4) where a PNG says which value is transparent."""
    values = np.asarray(image, np.float32)
    gray, clear = values / np.float32(65535), image.info.get("transparency")
    if clear is None:
        return reduced(gray, size)
    alpha = (values != clear).astype(np.float32)
    return reduced(np.stack([gray, gray, gray, alpha], axis=-1), size)


def save(path: str | os.PathLike[str], image: Float32) -> None:
    """Write an image (H, W), (H, W, 3) or (H, W, 4) to the file `path`, whose ending says how.

    .tif, .tiff, .exr (with the extra exr): 32-bit floats, any values, without loss.  .hdr: colors
    that are not negative, to 1 % of the largest channel.  Other endings that Pillow writes, such as
    .png: 8 bits, values in [0, 1].

    Raises ImageError, before anything is written, for another ending, what is no image, NaN and
    infinity but in floats, and an alpha channel where the format has none; OSError if it cannot be
    written.
    """
    Path(path).write_bytes(encoded(image, Path(path).suffix))


def encoded(image: Float32, suffix: str) -> bytes:
    """What `save` writes to a file of that ending."""
    pixels, suffix = np.asarray(image, np.float32), suffix.lower()
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (1,), (3,), (4,)):
        raise ImageError(f"an image to save has axes (H, W) or (H, W, C), not {pixels.shape}")
    if suffix == _EXR:
        return exr.encoded(pixels)
    if suffix not in _TIFF and not np.isfinite(pixels).all():
        raise ImageError(f"{suffix} holds no NaN and no infinity; save the image as .tif or .exr")
    if suffix == ".hdr" and (pixels.shape[2:] == (4,) or (pixels < 0).any()):
        raise ImageError(".hdr holds no alpha and no negative values; save it as .tif or .exr")
    if suffix in _OPENCV:
        from fide_plugins.runtime.opencv import cv2

        if pixels.ndim == 3 and pixels.shape[2] > 1:
            pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
        _, data = cv2.imencode(suffix, np.ascontiguousarray(pixels))
        return bytes(data.tobytes())
    from PIL import Image

    form = Image.registered_extensions().get(suffix)
    if form is None:
        raise ImageError(f"images cannot be written as {suffix!r}; name a .tif or .png")
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    buffer = io.BytesIO()
    whole = Image.fromarray(np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8))
    try:
        whole.save(buffer, form)
    except Exception as e:  # each format has its own
        got = f"an image of shape {pixels.shape}"
        raise ImageError(f"{suffix} cannot hold {got}: {e}; save it as .png or .tif") from e
    return buffer.getvalue()
