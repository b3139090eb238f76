"""Renders that are a torch tensor on a GPU: checked and converted there, by the rules of `images`.

Only counts and extremes of their values come to the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from fide_plugins.errors import FeaturesError
from fide_plugins.validation.pixels import (
    OnClip,
    ValueRange,
    channels_last,
    check_batch_axes,
    check_count,
    from_tensor,
    is_clipped,
    is_torch_tensor,
    refuse_not_finite,
    warn_clipped,
)

if TYPE_CHECKING:
    from fide_plugins.encoders.base import PatchEncoder


_WITH_NUMPY = ("cpu", "mps")  # whose images NumPy and OpenCV process: MPS has no float64


def stays_on_device(images: object) -> TypeGuard[Tensor]:
    """Whether they are a tensor that can be processed where it is, on a GPU.

    On the CPU OpenCV is faster, and a tensor there shares its memory with NumPy.
    """
    return is_torch_tensor(images) and images.device.type not in _WITH_NUMPY  # type: ignore[attr-defined]


def as_tensor_batch(
    images: Tensor,
    shape: Sequence[int] | None = None,
    *,
    n: int | None = None,
    on_clip: OnClip = warn_clipped,
    values: ValueRange | None = None,
) -> Tensor:
    """Return a canonical batch on the device of the images, see `images.as_batch`.

    images: (n, H, W), (n, H, W, C) or (n, C, H, W); the result is float32 (n, H, W, 3) in [0, 1],
    without gradients, perhaps the images themselves.  Other arguments and errors are the same.
    """
    size = None if shape is None else (int(shape[0]), int(shape[1]))
    what = "the batch of images"
    images = images.detach()
    if not (images.is_floating_point() or images.dtype in (torch.uint8, torch.bool)):
        from_tensor(images, what, values is not None)  # raises, but for numbers with a range
    check_batch_axes(images, size, what)
    check_count(len(images), n)
    pixels = _unit_range(channels_last(images, 1, True, size, what), what, on_clip, values)
    if pixels.shape[-1] == 4:
        color, alpha = pixels[..., :3], pixels[..., 3:]
        return 1.0 - alpha * (1.0 - color)
    return pixels.expand(*pixels.shape[:-1], 3)


def _unit_range(pixels: Any, what: str, on_clip: OnClip, scale: ValueRange | None) -> Tensor:
    """Values of (..., C) as float32 in [0, 1]."""
    values: Tensor = pixels.float() if scale is None else _scaled(pixels, scale)
    if scale is None and pixels.dtype == torch.uint8:
        return values / 255
    if (scale is None and pixels.dtype == torch.bool) or not pixels.numel():
        return values
    low, high = torch.stack([values.min(), values.max()]).cpu().tolist()  # two numbers, one copy
    if not (isfinite(low) and isfinite(high)):
        bad = values.numel() - int(torch.isfinite(values).sum())
        raise refuse_not_finite(what, bad, pixels)
    if not is_clipped(values, pixels, low, high, what, on_clip, scale):
        return values
    return values.clamp(0.0, 1.0)


def _scaled(pixels: Tensor, scale: ValueRange) -> Tensor:
    """Float32 (..., C) of which [0, 1] is the value range, and the alpha channel has its own."""
    colors = ((pixels[..., :3].double() - scale.low) / scale.span).float()
    if pixels.shape[-1] != 4:
        return colors
    alpha = pixels[..., 3:]
    whole = not (alpha.is_floating_point() or alpha.dtype == torch.bool)
    share = alpha / torch.iinfo(alpha.dtype).max if whole else alpha
    return torch.cat([colors, share.float()], dim=-1)


# -- features that were encoded by a remote worker -------------------------------------------------


def as_features(
    features: Any,
    shape: tuple[int, int, int],
    encoder: PatchEncoder,
    *,
    version: str | None = None,
    device: torch.device | None = None,
) -> torch.Tensor:
    """Tokens of n images as float32 (n, T, C) on the device.

    features: array or tensor, or a list of n arrays or tensors (T, C).
    shape: required shape (n, T, C); T and C are those of the target's tokens.
    encoder: that of the optimizer.
    version: attribute `version` of the encoder that made the features, which is compared: two
        versions may give features of the same shape.  None: unknown.
    device: of the result; None: that of the encoder.

    Raises FeaturesError (a ValueError) for another version, another shape, no real numbers, or
    values that are not finite.
    """
    if version is not None and version != encoder.version:
        raise FeaturesError(
            f"features must be by the optimizer's own encoder, of the version {encoder.version!r}, "
            f"not {version!r}; encode the images again with that, or tell the images themselves"
        )
    rule = (
        f"features must be what the encoder {encoder.name!r} gives for images of the target's "
        f"size, (n, T, C) = {shape}"
    )
    try:
        several = isinstance(features, list | tuple)
        array = np.stack(list(map(_as_array, features))) if several else _as_array(features)
    except (TypeError, ValueError, RuntimeError) as error:
        raise FeaturesError(f"{rule}: {error}") from error
    if array.dtype.kind != "f":
        raise FeaturesError(f"{rule}, of floating point, not {array.dtype}")
    if array.shape != shape:
        raise FeaturesError(f"{rule}, not {array.shape}; is it the same encoder, for each point?")
    with np.errstate(over="ignore"):  # too large for float32: not finite, and refused
        tokens = torch.from_numpy(array.astype(np.float32))
    if not torch.isfinite(tokens).all():
        raise FeaturesError(f"{rule}, and finite; leave out images that have none")
    return tokens.to(encoder.device if device is None else device)


def _as_array(features: Any) -> np.ndarray[Any, Any]:
    if isinstance(features, torch.Tensor):
        features = features.detach().cpu().numpy()
    return np.asarray(features)
