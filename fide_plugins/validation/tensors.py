"""Features that were encoded elsewhere.

A remote worker can encode its image where it renders, and send the tokens instead of the picture:

    encoder = encoders.make("dense")             # there
    tokens = encoder(images)                     # (n, T, C)
    opt.tell(X, losses=losses, features=tokens, version=encoder.version)  # here

Two versions of an encoder, or two files of its weights, give features of the same shape.  If the
caller passes the version, it is compared; otherwise the caller is responsible for it.
"""

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

    Parameters
    ----------
    features
        array or tensor, or a list of n arrays or tensors (T, C).
    shape
        required shape (n, T, C); T and C are those of the target's tokens.
    encoder
        encoder of the optimizer.
    version
        attribute `version` of the encoder that made the features; None: unknown.
    device
        device of the result; None: that of the encoder.

    Raises
    ------
    FeaturesError
        another version, another shape, no real numbers, or values that are not finite (also a
        ValueError).
    """
    _check_version(version, encoder)
    rule = (
        f"features must be what the encoder {encoder.name!r} gives for images of the target's "
        f"size, (n, T, C) = {shape}"
    )
    array = _stacked(features, rule)
    if array.shape != shape:
        raise FeaturesError(f"{rule}, not {array.shape}; is it the same encoder, for each point?")
    with np.errstate(over="ignore"):  # too large for float32: not finite, and refused
        tokens = torch.from_numpy(array.astype(np.float32))
    if not torch.isfinite(tokens).all():
        raise FeaturesError(f"{rule}, and finite; leave out images that have none")
    return tokens.to(encoder.device if device is None else device)


def _check_version(version: str | None, encoder: PatchEncoder) -> None:
    if version is not None and version != encoder.version:
        raise FeaturesError(
            f"features must be by the optimizer's own encoder, of the version {encoder.version!r}, "
            f"not {version!r}; encode the images again with that, or tell the images themselves"
        )


def _stacked(features: Any, rule: str) -> np.ndarray[Any, Any]:
    """One array of floating point numbers; FeaturesError with the rule for anything else."""
    try:
        if isinstance(features, list | tuple):
            features = np.stack([_as_array(tokens) for tokens in features])
        array = _as_array(features)
    except (TypeError, ValueError, RuntimeError) as error:
        raise FeaturesError(f"{rule}: {error}") from error
    if array.dtype.kind != "f":
        raise FeaturesError(f"{rule}, of floating point, not {array.dtype}")
    return array


def _as_array(features: Any) -> np.ndarray[Any, Any]:
    if isinstance(features, torch.Tensor):
        features = features.detach().cpu().numpy()
    return np.asarray(features)
