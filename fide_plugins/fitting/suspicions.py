"""What a best image says about how the renderer writes its images, at the end of a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.types import Float32

__all__ = ["suspicion_of"]

_BETTER = 0.25  # of the squared error, from which on a change of all values explains it
_LARGE = 50.0  # factor that no choice of parameters has brought about


def suspicion_of(optimizer: FIDE) -> str | None:
    """Sentence that says what seems wrong with all renders; None: nothing.

    Compared are mean squared errors of the best image, whatever the loss is.
    """
    best = optimizer.state.best
    image = None if best is None else best.solution.image
    if image is None or optimizer.status.code in ("solved", "noise"):
        return None
    views, error = optimizer.views, optimizer.views.squared_error(image)
    swapped = views.squared_error(np.ascontiguousarray(image[..., ::-1]))
    if swapped < _BETTER * error:
        return (
            f"the best image fits much better with red and blue swapped (mean squared error "
            f"{swapped:.3g} in place of {error:.3g}): if the renderer gives BGR, as OpenCV does, "
            "return image[..., ::-1]"
        )
    factor = _factor(image, views.target)
    scaled = views.squared_error(np.clip(np.float32(factor) * image, 0.0, 1.0))
    if factor > _LARGE and scaled < _BETTER * error:
        return (
            f"the best image fits much better if it is {factor:.3g} times as bright (mean squared "
            f"error {scaled:.3g} in place of {error:.3g}): are the renders on the target's scale? "
            "uint8 is in [0, 255], floats are in [0, 1]; masks of 0 and 1 are bool"
        )
    return None


def _factor(image: Float32, target: Float32) -> float:
    """Factor by which an image is nearest to the target."""
    one, other = image.astype(np.float64).ravel(), target.astype(np.float64).ravel()
    square = float(one @ one)
    return float(one @ other) / square if square > 0 else 0.0
