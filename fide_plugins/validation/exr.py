"""OpenEXR files, by the package of that name.

An EXR file has colors multiplied by their alpha; images here have colors that are not.
"""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32

__all__ = ["decoded", "encoded"]

_COLORS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
_FLOATS = (np.float16, np.float32)
_OTHERS = 8  # channels besides colors that may be in a file, such as depth and normals


def decoded(path: str | os.PathLike[str], most: int) -> Float32:
    """Pixels (H, W), (H, W, 3) or (H, W, 4) of the channels Y, RGB or RGBA of a file.

    Those of its data window, halves and floats as they are.  most: pixels that it may have; the
    header is looked at before any pixel is read.

    Raises ImageError, DependencyError.
    """
    exr, what = _package(), repr(os.fspath(path))
    try:
        with open(path, "rb") as file:
            names = _checked(exr, exr.File(file, header_only=True, num_threads=0), what, most)
            file.seek(0)
            read = exr.File(file, separate_channels=True, num_threads=0).channels()
            planes = [read[name].pixels for name in names]
    except ImageError:
        raise
    except Exception as error:  # decoders of untrusted bytes raise nearly anything
        raise ImageError(f"cannot read {what} as an image: {error}; is it whole?") from error
    if any(plane.dtype not in _FLOATS or plane.shape != planes[0].shape for plane in planes):
        raise ImageError(f"{what} has colors that are not halves or floats of one size")
    pixels = np.stack(planes, axis=-1).astype(np.float32)
    if names[-1] == "A":
        alpha = pixels[..., -1:]
        with np.errstate(over="ignore", invalid="ignore"):
            np.divide(pixels[..., :-1], alpha, out=pixels[..., :-1], where=alpha > 0)
        return pixels if len(names) == 4 else pixels[..., [0, 0, 0, 1]]
    return pixels if len(names) == 3 else pixels[..., 0]


def encoded(pixels: Float32) -> bytes:
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


def _checked(exr: Any, file: Any, what: str, most: int) -> tuple[str, ...]:
    """Names of the channels to take, by the header of a file; raises ImageError."""
    sizes = []
    for part in file.parts:
        header = part.header
        low, high = header["dataWindow"]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        if header.get("type", exr.scanlineimage) not in (exr.scanlineimage, exr.tiledimage):
            raise ImageError(f"{what} has deep pixels; flatten it first")
        if min(width, height) < 1 or width * height > most:
            raise ImageError(f"{what} has {width} x {height} pixels, not 1 to {most:,}; reduce it")
        sizes.append(width * height * len(header["channels"]))
    channels = {one.name: one for one in file.parts[0].header["channels"]}
    names = next((names for names in _COLORS if channels.keys() >= set(names)), None)
    if names is None:
        found = ", ".join(sorted(channels)[:8]) or "none"
        raise ImageError(
            f"{what} has no channels R, G, B or Y in its first part, but {found}: give the array, "
            "such as OpenEXR.File(path).channels()[NAME].pixels"
        )
    if sum(sizes) > most * (4 + _OTHERS):
        raise ImageError(f"{what} has too many channels for its size; save its colors alone")
    if any(channels[name].xSampling != 1 or channels[name].ySampling != 1 for name in names):
        raise ImageError(f"{what} has colors of a lower resolution; save it as RGB")
    return names
