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
from fide_plugins.runtime.files import RefusedFileError, check_regular
from fide_plugins.runtime.warn import warn_user

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
    "unmasked",
]

Pixels: TypeAlias = npt.NDArray[Any]

MAX_PIXELS = 2**26
"""Most pixels an image file may decode to (67 megapixels, 0.8 GB as float32)."""
_WIDENED = ("PNG", "PPM")  # formats of 16 bits, which Pillow may keep in 32
_HIGH_RANGE = (".exr", ".hdr")  # formats without a white
_TIFF = (".tif", ".tiff")  # Pillow reads floats of gray ones only
_LAYERED = ("MPO", "PSD")  # their first frame is the picture, the others belong to it


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
        check_regular(path)
        with Image.open(path) as image:
            frames = 1 if image.format in _LAYERED else getattr(image, "n_frames", 1)
            whole = image.size
            if max_side is not None:
                image.draft(None, (max_side, max_side))  # JPEG: decode at a fraction of its size
            pixels = from_pil(image, repr(os.fspath(path)), max_side, whole)
    except FileNotFoundError as e:
        raise ImageNotFoundError(f"no image file at {os.fspath(path)!r}") from e
    except ImageError:
        raise
    except RefusedFileError as e:
        raise ImageError(f"{e} with an image") from e
    except Exception as e:  # decoders of untrusted bytes raise nearly anything
        name = os.fspath(path)
        remedy = "is it whole, and is it an image? PNG, JPEG, TIFF and PPM can be read"
        if name.lower().endswith(_HIGH_RANGE):
            remedy = (
                "PNG, JPEG, TIFF and PPM can be read, EXR and HDR cannot: convert it, with the "
                "tone mapping of your renderer"
            )
        elif name.lower().endswith(_TIFF):
            remedy = "is it whole? Colors of TIFF must be integers: write floats as 16 bits"
        raise ImageError(f"cannot read {name!r} as an image: {e}; {remedy}") from e
    if frames > 1:
        name = os.path.basename(os.fspath(path))
        warn_user(f"{name} has {frames} frames or pages, of which the first one is taken")
    return pixels


def from_pil(
    image: Any, what: str, max_side: int | None = None, whole: tuple[int, int] | None = None
) -> Pixels:
    """Array of a PIL image, turned upright, with at most `max_side` pixels a side; ImageError.

    whole: width and height of the picture of which the image is a rough reduction; None: its own.
    """
    from PIL import Image, ImageOps

    width, height = image.size
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{what} has {width} x {height} pixels, more than {MAX_PIXELS:,}; reduce it first"
        )
    form, whole = image.format, whole or image.size
    image = ImageOps.exif_transpose(image)
    if image.size != (width, height):
        whole = whole[::-1]
    size = whole if max_side is None else _reduced(whole, max_side)
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


def _reduced(size: tuple[int, int], max_side: int) -> tuple[int, int]:
    """Width and height with the longer one at most `max_side`."""
    if max(size) <= max_side:
        return size
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    return width, height


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
    from PIL import Image

    def reduced(values: Pixels) -> Pixels:
        plane = Image.fromarray(values)
        return np.asarray(plane if plane.size == size else plane.resize(size, Image.Resampling.BOX))

    values = np.asarray(image, np.float32)
    gray, clear = values / np.float32(65535), image.info.get("transparency")
    if clear is None:
        return reduced(gray)
    shown = (values != clear).astype(np.float32)
    light, alpha = reduced(gray * shown), reduced(shown)
    gray = np.divide(light, alpha, out=np.zeros_like(light), where=alpha > 0)
    return np.stack([gray, gray, gray, alpha], axis=-1)
