"""Reads masks and weights of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.images import alpha_of, as_target
from fide_plugins.validation.pixels import is_torch_tensor

__all__ = ["ALPHA", "hidden_by", "joined", "read_weights"]

ALPHA = "alpha"
"""In place of a mask: the alpha channel of the target."""


def read_weights(given: object, target: object, size: tuple[int, int], what: str) -> Float32 | None:
    """Weights (H, W) in [0, 1] of a picture, of which the largest is 1; None if all are equal.

    given: a gray picture, any input of `as_target`, of that size, gray times alpha where it is
        transparent; "alpha" for the alpha channel of the target; None.
    what: its name in errors.

    Raises ImageError: wrong size, colors, values outside [0, 1], NaN, or zeros everywhere.
    """
    if given is None:
        return None
    if isinstance(given, str) and given == ALPHA:
        try:
            weights = alpha_of(target, f"the target of {what}='alpha'")
        except ImageError as error:
            raise ImageError(f"{error}; or give a {what} of its own, {what}=ARRAY") from error
    else:
        picture = as_target(_large_enough(given), what=what, size=size, behind=0.0)
        weights = picture[..., 0].copy()
        if (picture != weights[..., None]).any():
            raise ImageError(f"{what} must be gray, (H, W), but it has colors; pass one channel")
    return joined(weights, None, what)


def _large_enough(given: object) -> object:
    """Weights times a constant, where single precision would hold no more than zeros of them."""
    values: Any = given
    if isinstance(given, (list, tuple)):
        try:
            values = np.asarray(given)
        except (TypeError, ValueError, RuntimeError):  # `as_target` says what is wrong
            return given
    if not isinstance(values, np.ndarray) and not is_torch_tensor(values):
        return given
    if not str(values.dtype).endswith("float64") or 0 in values.shape or values.min() < 0:
        return given
    largest = values.max()
    return values / largest if 0 < largest < np.finfo(np.float32).tiny else given


def joined(a: Float32 | None, b: Float32 | None, what: str) -> Float32 | None:
    """Product of two weights (H, W), None for ones, of which the largest becomes 1.

    None if all are equal.  Raises ImageError for zeros everywhere.
    """
    if a is None and b is None:
        return None
    product = np.asarray((1 if a is None else a) * (1 if b is None else b))
    largest = product.max()
    if largest <= 0:
        raise ImageError(
            f"{what} is zero everywhere, so no pixel of the picture counts; white is what counts, "
            "black or transparent what is hidden"
        )
    if product.min() == largest:
        return None
    weights: Float32 = np.ascontiguousarray(product / largest, np.float32)
    return weights


def hidden_by(weights: Float32 | None) -> Mask | None:
    """Pixels (H, W) of weight 0; None if there are none."""
    hidden = None if weights is None else weights == 0
    return None if hidden is None or not hidden.any() else hidden
