"""Features that were encoded where a remote worker rendered."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from fide_plugins.errors import FeaturesError

if TYPE_CHECKING:
    from fide_plugins.encoders.base import PatchEncoder


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
