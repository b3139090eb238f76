"""Pixels from what an image may be: a path, a PIL image, a torch tensor.

PyTorch and Pillow are imported only if an image needs them.
"""

from __future__ import annotations

import os
import sys
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import DependencyError, ImageError, ImageNotFoundError

__all__ = [
    "MAX_PIXELS",
    "Pixels",
    "describe",
    "from_pil",
    "from_tensor",
    "has_scale",
    "is_path",
    "is_pil",
    "is_torch_tensor",
    "read_pixels",
    "refuse_type",
    "scale_remedy",
]

Pixels: TypeAlias = npt.NDArray[Any]

MAX_PIXELS = 2**26
"""Most pixels an image file may decode to (67 megapixels, 0.8 GB as float32)."""


def describe(pixels: Any) -> str:
    """Shape and dtype of an array or a tensor, for errors."""
    return f"shape {tuple(pixels.shape)}, dtype {str(pixels.dtype).removeprefix('torch.')}"


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


def from_tensor(tensor: Any, what: str) -> Pixels:
    """Array of a tensor on any device; ImageError for types that no image has."""
    try:
        tensor = tensor.detach().cpu()
        if tensor.dtype.is_floating_point and tensor.dtype.itemsize <= 2:
            tensor = tensor.float()  # numpy has no bfloat16
        array: Pixels = tensor.numpy()
    except (TypeError, RuntimeError, ValueError) as e:
        raise ImageError(f"{what}, a {tensor.dtype} tensor, is not an image: {e}") from e
    if not has_scale(array):
        remedy = scale_remedy(array, "image.bool()", "image.to(torch.uint8)")
        raise refuse_type(what, f"a tensor of {describe(array)}", remedy)
    return array


def has_scale(array: Pixels) -> bool:
    """Whether the type of an array says which value is white."""
    return array.dtype.kind in "fb" or array.dtype == np.uint8


def scale_remedy(
    array: Pixels,
    as_bool: str,
    as_bytes: str,
) -> str:
    """What to write for an array whose type does not say it; as_bool, as_bytes: conversions."""
    if array.dtype.kind not in "iu" or not array.size or array.min() < 0:
        return "convert it to floats in [0, 1]"
    high = int(array.max())
    if array.dtype == np.uint16 or high > 255:
        return "divide by the value that is white, for example image / 65535"
    if high <= 1:
        return f"write {as_bool} if 1 is white, {as_bytes} if 255 is"
    return f"write {as_bytes} if 255 is white"


def refuse_type(what: str, got: str, remedy: str) -> ImageError:
    """Error for values of a type whose scale is unknown."""
    return ImageError(
        f"{what} must be uint8 in [0, 255], bool, or floating in [0, 1], got {got}; {remedy}"
    )


def read_pixels(path: str | os.PathLike[str], max_side: int | None) -> Pixels:
    """Decode an image file; the size in its header is checked before any pixel is."""
    try:
        from PIL import Image
    except ImportError as e:
        raise DependencyError("reading an image file needs Pillow: pip install pillow") from e
    try:
        with Image.open(path) as image:
            if max_side is not None:
                image.draft(None, (max_side, max_side))  # JPEG: decode at a fraction of its size
            return from_pil(image, repr(os.fspath(path)), max_side)
    except FileNotFoundError as e:
        raise ImageNotFoundError(f"no image file at {os.fspath(path)!r}") from e
    except ImageError:
        raise
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        raise ImageError(f"cannot read {os.fspath(path)!r} as an image: {e}") from e


def from_pil(image: Any, what: str, max_side: int | None = None) -> Pixels:
    """Array of a PIL image, turned upright, with at most `max_side` pixels a side; ImageError."""
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
