"""Pixels of image files and PIL images, and image files of pixels.

Pillow reads most files.  OpenCV reads those that Pillow cannot: TIFF of float colors, Radiance HDR,
colors of 16 bits where their numbers matter.  The extra exr reads EXR.
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
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32
from fide_plugins.validation.pixels import MAX_PIXELS, Pixels, describe, typed

_WIDENED = ("PNG", "PPM")  # formats of 16 bits, which Pillow may keep in 32
_TIFF = (".tif", ".tiff")  # Pillow reads floats of gray ones only
_LAYERED = ("MPO", "PSD")  # their first frame is the picture, the others belong to it
_OPENCV = (*_TIFF, ".hdr")
_EXR = ".exr"
_ORIENTATION = 0x0112  # EXIF


def read_pixels(path: str | os.PathLike[str], max_side: int | None, *, raw: bool = False) -> Pixels:
    """Decode an image file; the size in its header is checked before any pixel is decoded.

    raw: numbers as they are stored; otherwise those of 16 bits are divided by 65535.  Raises
    ImageError, ImageNotFoundError, DependencyError for EXR without its extra.
    """
    from PIL import Image  # takes a while

    try:
        check_regular(path)
        with Image.open(path) as image:
            frames = 1 if image.format in _LAYERED else getattr(image, "n_frames", 1)
            whole = image.size
            if max_side is not None:
                image.draft(None, (max_side, max_side))  # JPEG: decode at a fraction of its size
            if _narrowed(image):
                colors = _by_opencv(path, max_side, raw)
                pixels = _upright(colors, image.getexif().get(_ORIENTATION, 1))
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


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """Pixels (H, W, C) turned by the number that EXIF has for it."""
    turned = pixels.swapaxes(0, 1) if orientation in (5, 6, 7, 8) else pixels
    turned = turned[:, ::-1] if orientation in (2, 3, 6, 7) else turned
    return np.ascontiguousarray(turned[::-1] if orientation in (3, 4, 7, 8) else turned)


def _of_another_format(
    path: str | os.PathLike[str], max_side: int | None, raw: bool, error: Exception
) -> Pixels:
    """Decode by OpenCV or OpenEXR what Pillow cannot; raises ImageError, DependencyError."""
    name = os.fspath(path)
    try:
        if name.lower().endswith(_EXR):
            colors = _decoded_exr(path)
            return reduced(colors, _reduced_size(colors.shape[1::-1], max_side))
        if name.lower().endswith(_OPENCV):
            return _by_opencv(path, max_side, raw)
    except FideError:
        raise
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        error = e
    raise ImageError(
        f"cannot read {name!r} as an image: {error}; is it whole, and is it an image? PNG, JPEG, "
        "TIFF, PPM, HDR and EXR can be read"
    ) from error


def _by_opencv(path: str | os.PathLike[str], max_side: int | None, raw: bool) -> Pixels:
    """Pixels (H, W) or (H, W, C) of a file; raises ImageError.  raw: see `read_pixels`."""
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
    small = reduced(pixels, _reduced_size(pixels.shape[1::-1], max_side))
    return small / np.float32(65535) if pixels.dtype == np.uint16 and not raw else small


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
    size = _reduced_size(whole if image.size == (width, height) else whole[::-1], max_side)
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if raw:
            return reduced(values, size)
        if not (image.mode.startswith("I;16") or form in _WIDENED):  # 32 bits: what is white?
            typed(values, what, describe(values))
        return _of_16_bits(values.astype(np.float32), image.info.get("transparency"), size)
    if image.has_transparency_data:
        image = image.convert("RGBA")
    elif image.mode not in ("F", "1"):
        image = image.convert("RGB")
    if image.size != size:
        image = image.convert("L" if image.mode == "1" else image.mode)
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image)


def _of_16_bits(values: Float32, clear: int | None, size: tuple[int, int]) -> Pixels:
    """Gray (H, W) in [0, 1]; (H, W, 4) where a PNG says which value is transparent."""
    gray = values / np.float32(65535)
    if clear is None:
        return reduced(gray, size)
    alpha = (values != clear).astype(np.float32)
    return reduced(np.stack([gray, gray, gray, alpha], axis=-1), size)


def encoded(image: Float32, suffix: str) -> bytes:
    """What `images.save` writes to a file of that ending."""
    pixels, suffix = np.asarray(image, np.float32), suffix.lower()
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (1,), (3,), (4,)):
        raise ImageError(f"an image to save has axes (H, W) or (H, W, C), not {pixels.shape}")
    if suffix == _EXR:
        return _encoded_exr(pixels)
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


# -- OpenEXR ---------------------------------------------------------------------------------------
#
# An EXR file has colors multiplied by their alpha; images here have colors that are not.

_COLORS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
_FLOATS = (np.float16, np.float32)
_PLANES = 12  # most channels of a large image, such as colors, depth and normals


def _decoded_exr(path: str | os.PathLike[str]) -> Float32:
    """Pixels (H, W), (H, W, 3) or (H, W, 4) of the channels Y, RGB or RGBA in the data window."""
    exr, what = _package(), repr(os.fspath(path))
    with open(path, "rb") as file:
        names = _checked(exr.File(file, header_only=True, num_threads=0), what)
        file.seek(0)
        read = exr.File(file, separate_channels=True, num_threads=0).channels()
        planes = [read[name].pixels for name in names]
    if any(plane.dtype not in _FLOATS or plane.shape != planes[0].shape for plane in planes):
        raise ImageError(f"{what} has colors that are not halves or floats of one size")
    pixels = np.stack(planes, axis=-1).astype(np.float32)
    if names[-1] == "A":
        alpha = pixels[..., -1:]
        with np.errstate(over="ignore", invalid="ignore"):
            np.divide(pixels[..., :-1], alpha, out=pixels[..., :-1], where=alpha > 0)
        return pixels if len(names) == 4 else pixels[..., [0, 0, 0, 1]]
    return pixels if len(names) == 3 else pixels[..., 0]


def _encoded_exr(pixels: Float32) -> bytes:
    """File with the 32-bit floats of an image (H, W), (H, W, 1), (H, W, 3) or (H, W, 4)."""
    exr, buffer = _package(), io.BytesIO()
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    if planes.shape[2] == 4:
        planes = np.concatenate([planes[..., :3] * planes[..., 3:], planes[..., 3:]], axis=2)
    names = "Y" if planes.shape[2] == 1 else "RGBA"[: planes.shape[2]]
    channels = {name: np.ascontiguousarray(planes[..., i]) for i, name in enumerate(names)}
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    exr.File(header, channels, num_threads=0).write(buffer)
    return buffer.getvalue()


def _package() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise missing("exr", "reading and writing EXR files needs OpenEXR") from error
    return OpenEXR


def _checked(file: Any, what: str) -> tuple[str, ...]:
    """Names of the channels to take, by the header of a file; raises ImageError."""
    values = 0
    for part in file.parts:
        low, high = part.header["dataWindow"]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        values += width * height * len(part.header["channels"])
        _check_size(width, height, what)
        if min(width, height) < 1 or values > _PLANES * MAX_PIXELS:
            got = f"{width} x {height} pixels, and {values:,} values in all channels"
            raise ImageError(f"{what} has {got}; reduce it, or save its colors alone")
    channels = {one.name for one in file.parts[0].header["channels"]}
    names = next((names for names in _COLORS if channels >= set(names)), None)
    if names is None:
        found = ", ".join(sorted(channels)[:8]) or "none"
        raise ImageError(
            f"{what} has no channels R, G, B or Y in its first part, but {found}: give the array, "
            "such as OpenEXR.File(path).channels()[NAME].pixels"
        )
    return names


# -- pictures made smaller: each pixel is a mean of those that it covers, weighted by a mask -------


def _reduced_size(size: tuple[int, ...], max_side: int | None) -> tuple[int, int]:
    """Width and height with the longer one at most `max_side`."""
    if max_side is None or max(size) <= max_side:
        return size[0], size[1]
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    return width, height


def reduced(pixels: Pixels, size: tuple[int, int], weights: Pixels | None = None) -> Pixels:
    """Pixels (H, W) or (H, W, C) in the size (width, height); themselves if they have it.

    They come back as float32 in their own range.  Colors of four channels are weighted by the last
    one, the alpha channel.  weights: (H, W); what has no weight at all becomes 0.
    """
    if pixels.shape[1::-1] == size:
        return pixels
    values: Float32 = pixels.astype(np.float32)
    if values.ndim == 2 or values.shape[2] != 4:
        return _mean(values, size, weights)
    alpha = values[..., 3] if weights is None else np.where(weights > 0, values[..., 3], 0)
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
    size = _reduced_size(pixels.shape[1::-1], max_side)
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
    weights = weights.astype(np.float32).reshape(*values.shape[:2], *[1] * (values.ndim - 2))
    sums = _by_channel(np.where(weights > 0, values, 0) * weights, size)
    total = _by_channel(weights, size)
    return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)


def _by_channel(values: Float32, size: tuple[int, int]) -> Float32:
    from PIL import Image

    small = [
        np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize(size, Image.Resampling.BOX))
        for plane in np.moveaxis(np.atleast_3d(values), -1, 0)
    ]
    return np.stack(small, axis=-1).reshape(*small[0].shape, *values.shape[2:])
