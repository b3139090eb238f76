"""What a best image says about how the renderer writes its images, at the end of a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.types import Float32
    from fide_plugins.views import Views

__all__ = ["Extremes", "suspicion_of"]

_BETTER = 0.25  # of the squared error, from which on a change of all values explains it
_LARGE = 50.0  # factor that no choice of parameters has brought about
_NARROW = 0.02  # of the target's range, of which renders show something


class Extremes:
    """Range of the values of all renders, as far as it is narrow: then nothing more is measured.

    views: of the target; there is nothing to measure without a range of values.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._low, self._high = np.inf, -np.inf
        low, high = self._of(views.target)
        self._span = high - low
        self.wanted = views.values is not None and self._span > 0
        """Whether further renders are to be measured."""

    def note(self, image: Float32) -> None:
        """Count a packed image in [0, 1]."""
        low, high = self._of(image)
        self._low, self._high = min(self._low, low), max(self._high, high)
        self.wanted = self._high - self._low < _NARROW * self._span

    def suspicion(self) -> str | None:
        """What is wrong if the renders are narrow."""
        values = self._views.values
        if not self.wanted or values is None or self._low > self._high:
            return None
        ends = [values.low + end * values.span for end in (self._low, self._high)]
        return (
            f"all renders have values in [{ends[0]:.4g}, {ends[1]:.4g}], less than {_NARROW:.0%} "
            f"of the range of the target, {self._span * values.span:.4g}: are they on its scale? "
            "With value_range all types are numbers as they are; where floats in [0, 1] meet a "
            "target of uint8, return 255 * image"
        )

    def _of(self, image: Float32) -> tuple[float, float]:
        """Least and largest value of what counts of a packed image."""
        low, high = np.inf, -np.inf
        for view, part in zip(self._views.views, self._views.split(image[None]), strict=True):
            seen = part[0] if view.hidden is None else part[0][~view.hidden]
            low, high = min(low, float(seen.min())), max(high, float(seen.max()))
        return low, high


def suspicion_of(optimizer: FIDE, extremes: Extremes) -> str | None:
    """Sentence that says what seems wrong with all renders; None: nothing.

    extremes: of these.
    Compared are mean squared errors of the best image, whatever the loss is.
    """
    best = optimizer.state.best
    image = None if best is None else best.solution.image
    if image is None or optimizer.status.code in ("solved", "noise"):
        return None
    if narrow := extremes.suspicion():
        return narrow
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
