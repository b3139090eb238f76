"""Pixels from what an image may be, but for files (`image_files`): an array, a torch tensor.

PyTorch and Pillow are imported only if an image needs them.
"""

from __future__ import annotations

import os
import sys
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import ImageError, ValueRangeError

__all__ = [
    "Pixels",
    "describe",
    "from_tensor",
    "has_scale",
    "is_path",
    "is_pil",
    "is_torch_tensor",
    "refuse_type",
    "scale_remedy",
    "unmasked",
]

Pixels: TypeAlias = npt.NDArray[Any]


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


def from_tensor(tensor: Any, what: str, raw: bool = False) -> Pixels:
    """Array of a tensor on any device; ImageError for types that no image has.

    raw: whether any numbers will do.
    """
    try:
        tensor = tensor.detach().cpu()
        if tensor.dtype.is_floating_point and tensor.dtype.itemsize <= 2:
            tensor = tensor.float()  # numpy has no bfloat16
        array: Pixels = tensor.numpy()
    except (TypeError, RuntimeError, ValueError) as e:
        raise ImageError(f"{what}, a {tensor.dtype} tensor, is not an image: {e}") from e
    if not has_scale(array, raw):
        remedy = scale_remedy(array, "image.bool()", "image.to(torch.uint8)")
        whole = array.dtype.kind in "iu"
        raise refuse_type(what, f"a tensor of {describe(array)}", remedy, whole=whole)
    return array


def unmasked(image: Any, what: str) -> Pixels:
    """Values of a masked array; ImageError if some are masked, which would be lost."""
    hidden = int(np.count_nonzero(np.ma.getmaskarray(image)))
    if hidden:
        remedy = "give image.filled(value)"
        if what.split()[0] not in ("mask", "weights"):
            remedy += ", and say by mask= or weights= which pixels count"
        raise ImageError(
            f"{what} is a masked array with {hidden:,} masked values, and its mask would be lost; "
            f"{remedy}"
        )
    values: Pixels = image.data
    return values


def has_scale(array: Pixels, raw: bool = False) -> bool:
    """Whether the type of an array says which value is white; raw: whether it holds numbers."""
    return array.dtype.kind in ("fbiu" if raw else "fb") or array.dtype == np.uint8


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
        return (
            "divide by the value that is white, for example image / 65535, or give value_range, "
            "for example (0, 65535)"
        )
    if high <= 1:
        return f"write {as_bool} if 1 is white, {as_bytes} if 255 is"
    return f"write {as_bytes} if 255 is white"


def refuse_type(what: str, got: str, remedy: str, *, whole: bool = False) -> ImageError:
    """Error for values of a type that no image has.

    whole: whether they are whole numbers, whose scale is unknown: all renders of a run have it.
    """
    return (ValueRangeError if whole else ImageError)(
        f"{what} must be uint8 in [0, 255], bool, or floating in [0, 1], got {got}; {remedy}"
    )
