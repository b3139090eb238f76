"""Pixels of image files and PIL images, and image files of pixels.

Pillow reads most; OpenCV TIFF of floats, HDR, colors of 16 bits; the extra exr reads EXR.
"""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from fide_plugins.errors import FideError, ImageError, ImageNotFoundError
from fide_plugins.runtime.files import RefusedFileError, check_regular
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32
from fide_plugins.validation.values import MAX_PIXELS, Pixels, describe, typed

_WIDENED = ("PNG", "PPM")  # formats of 16 bits, which Pillow may keep in 32
_TIFF = (".tif", ".tiff")
_ORIENTATION = 0x0112  # EXIF
_LARGEST_16 = np.float32(65535)


def read_pixels(path: str | os.PathLike[str], max_side: int | None, *, raw: bool = False) -> Pixels:
    """Decode an image file; the size in its header is checked before any pixel is decoded.

    raw: numbers as they are stored; otherwise those of 16 bits are divided by 65535.
    Raises ImageError, ImageNotFoundError, DependencyError for EXR without its extra.
    """
    name = os.fspath(path)
    try:
        check_regular(path)
        if name.lower().endswith(".exr"):
            pixels = _by_openexr(name)
        elif name.lower().endswith(".hdr"):
            pixels = _by_opencv(path, raw)
        else:
            pixels = _by_pillow(path, raw)
    except FileNotFoundError as e:
        raise ImageNotFoundError(f"no image file at {name!r}") from e
    except FideError:
        raise
    except RefusedFileError as e:
        raise ImageError(f"{e} with an image") from e
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        raise ImageError(
            f"cannot read {name!r} as an image: {e}; is it whole, and is it an image? PNG, JPEG, "
            "TIFF, PPM, HDR and EXR can be read"
        ) from e
    return shrunk(pixels, None, max_side, raw=raw)[0]


def _by_pillow(path: str | os.PathLike[str], raw: bool) -> Pixels:
    """Pixels of a file, of several frames or pages those of the first."""
    from PIL import Image, UnidentifiedImageError  # takes a while

    try:
        opened = Image.open(path)
    except UnidentifiedImageError:
        if Path(path).suffix.lower() not in _TIFF:
            raise
        return _by_opencv(path, raw)
    with opened as image:
        tiles: Any = image.tile
        if image.mode in ("RGB", "RGBA") and any(
            ";16" in str(tile[3]) or (tile[0] == "ppm" and tile[3][1:] == (65535,))
            for tile in tiles
        ):
            _check_size(*image.size, repr(os.fspath(path)))
            return _upright(_by_opencv(path, raw), image.getexif().get(_ORIENTATION, 1))
        return from_pil(image, repr(os.fspath(path)), raw=raw)


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """Pixels (H, W, C) turned by the number that EXIF has for it."""
    turned = pixels.swapaxes(0, 1) if orientation in (5, 6, 7, 8) else pixels
    turned = turned[:, ::-1] if orientation in (2, 3, 6, 7) else turned
    return np.ascontiguousarray(turned[::-1] if orientation in (3, 4, 7, 8) else turned)


def _by_opencv(path: str | os.PathLike[str], raw: bool) -> Pixels:
    """Pixels (H, W) or (H, W, C) of a file; raises ImageError.  raw: see `read_pixels`."""
    from fide_plugins.runtime.opencv import cv2  # takes a while

    name = os.fspath(path)
    _check_size(*_size_in_header(Path(path)), repr(name))
    pixels = cv2.imread(name, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise ImageError(f"cannot read {name!r} as an image: is it whole? Save it as TIFF or PNG")
    if pixels.shape[2:] in ((3,), (4,)):  # BGR, BGRA
        pixels = np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])
    return pixels / _LARGEST_16 if pixels.dtype == np.uint16 and not raw else pixels


def _by_openexr(name: str) -> Float32:
    """Pixels (H, W) of Y, (H, W, 3) of RGB, (H, W, 4) of RGBA in the first part of a file."""
    try:
        import OpenEXR
    except ImportError as error:
        raise missing("exr", "reading EXR files needs OpenEXR") from error
    with open(name, "rb") as file:  # which reports a missing file as Python does
        for part in OpenEXR.File(file, header_only=True).parts:  # all of them are read
            (left, top), (right, bottom) = part.header["dataWindow"]
            _check_size(int(right) - int(left) + 1, int(bottom) - int(top) + 1, repr(name))
        file.seek(0)
        channels = OpenEXR.File(file, separate_channels=True).channels()
    names = next((one for one in ("RGBA", "RGB", "Y") if channels.keys() >= set(one)), "")
    planes = [channels[one].pixels for one in names]
    floats = all(one.dtype in (np.float16, np.float32) for one in planes)
    if not names or not floats or len({one.shape for one in planes}) > 1:
        found = ", ".join(sorted(channels)[:8]) or "none"
        raise ImageError(
            f"{name!r} has no channels R, G, B or Y of floats in its first part, but {found}: give "
            "the array, such as OpenEXR.File(path).channels()[NAME].pixels"
        )
    pixels: Float32 = np.stack(planes, axis=-1).astype(np.float32)
    if names == "RGBA":  # a file has colors multiplied by their alpha
        with np.errstate(over="ignore", invalid="ignore"):
            colors, alpha = pixels[..., :3], pixels[..., 3:]
            np.divide(colors, alpha, out=colors, where=alpha > 0)
    return pixels[..., 0] if names == "Y" else pixels


def _size_in_header(path: Path) -> tuple[int, int]:
    """Width and height of a TIFF, HDR or PNG file; raises whatever a wrong header causes."""
    from PIL import Image, TiffImagePlugin

    with path.open("rb") as file:
        if path.suffix.lower() in _TIFF:
            directory = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
            file.seek(directory.next)
            directory.load(file)
            return int(directory[256]), int(directory[257])
        if path.suffix.lower() == ".hdr":
            found = re.search(rb"[-+]Y (\d+) [-+]X (\d+)", file.read(2**16))
            if found is None:
                raise ValueError("its header has no size")
            return int(found[2]), int(found[1])
        with Image.open(file) as image:
            width, height = image.size
            return width, height


def _check_size(width: int, height: int, what: str) -> None:
    """Raise ImageError for too many pixels."""
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{what} has {width} x {height} pixels, more than {MAX_PIXELS:,}; reduce it first"
        )


def from_pil(image: Any, what: str, *, raw: bool = False) -> Pixels:
    """Array of a PIL image, turned upright; raises ImageError.  raw: see `read_pixels`."""
    from PIL import ImageOps

    width, height = image.size
    _check_size(width, height, what)
    form, image = image.format, ImageOps.exif_transpose(image)
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if raw:
            return values
        if not (image.mode.startswith("I;16") or form in _WIDENED):  # 32 bits: what is white?
            typed(values, what, describe(values))
        return values.astype(np.float32) / _LARGEST_16
    if image.has_transparency_data:
        image = image.convert("RGBA")
    elif image.mode not in ("F", "1"):
        image = image.convert("RGB")
    return np.asarray(image)


def encoded(image: Float32, suffix: str) -> bytes:
    """What `images.save` writes to a file of that ending."""
    pixels, suffix = np.asarray(image, np.float32), suffix.lower()
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (1,), (3,), (4,)):
        raise ImageError(f"an image to save has axes (H, W) or (H, W, C), not {pixels.shape}")
    if suffix in _TIFF:
        from fide_plugins.runtime.opencv import cv2

        if pixels.shape[2:] in ((3,), (4,)):
            pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
        _, data = cv2.imencode(suffix, np.ascontiguousarray(pixels))
        return bytes(data.tobytes())
    from PIL import Image

    form = Image.registered_extensions().get(suffix)
    if form is None or not np.isfinite(pixels).all():
        raise ImageError(f"{suffix!r} cannot hold this image; save it as .tif, or finite as .png")
    if pixels.shape[2:] == (1,):
        pixels = pixels[..., 0]
    buffer = io.BytesIO()
    whole = Image.fromarray(np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8))
    try:
        whole.save(buffer, form)
    except Exception as e:  # each format has its own
        got = f"an image of shape {pixels.shape}"
        raise ImageError(f"{suffix} cannot hold {got}: {e}; save it as .png or .tif") from e
    return buffer.getvalue()


def shrunk(
    pixels: Pixels, weights: Float32 | None, max_side: int | None, *, raw: bool = False
) -> tuple[Pixels, Float32 | None]:
    """Pixels and their weights (H, W), where a side has more than `max_side` pixels smaller.

    Both come back as float32 then: bytes in [0, 1], or, where their numbers are wanted (raw), as
    they are.  Alpha is in [0, 1] in any case.
    """
    height, width = pixels.shape[:2]
    if max_side is None or max(height, width) <= max_side:
        return pixels, weights
    scale = max_side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    if not raw and pixels.dtype in (np.uint8, np.bool_):
        pixels = pixels / np.float32(255 if pixels.dtype == np.uint8 else 1)
    elif pixels.shape[2:] == (4,) and pixels.dtype.kind in "iu":
        alpha = pixels[..., 3:] / np.float32(np.iinfo(pixels.dtype).max)
        pixels = np.concatenate([pixels[..., :3], alpha], axis=-1, dtype=np.float32)
    small = _reduced(pixels.astype(np.float32), size, weights)
    return small, None if weights is None else _mean(weights, size, None)


def _reduced(values: Float32, size: tuple[int, int], weights: Float32 | None) -> Float32:
    """Pixels (H, W) or (H, W, C) in the size (width, height); colors are weighted by alpha, too."""
    if values.shape[2:] != (4,):
        return _mean(values, size, weights)
    alpha = values[..., 3] if weights is None else np.where(weights > 0, values[..., 3], 0)
    opacity = _mean(alpha, size, weights)
    colors = _mean(values[..., :3], size, alpha if weights is None else alpha * weights)
    return np.concatenate([colors, opacity[..., None]], axis=-1)


def _mean(values: Float32, size: tuple[int, int], weights: Float32 | None) -> Float32:
    """Means of values (H, W) or (H, W, C); with weights weighted ones, 0 where there are none."""
    from fide_plugins.runtime.opencv import cv2

    def area(plane: Float32) -> Float32:
        small = cv2.resize(np.ascontiguousarray(plane), size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.float32).reshape(*small.shape[:2], *plane.shape[2:])

    if weights is None:
        return area(values)
    weights = weights.astype(np.float32).reshape(*values.shape[:2], *[1] * (values.ndim - 2))
    sums, total = area(np.where(weights > 0, values, 0) * weights), area(weights)
    return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)
