"""Which values are black and white: 0 and 1, or the two numbers of a user's `value_range`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fide_plugins.errors import ImageError, OptionError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.image_sources import Pixels

__all__ = ["AUTO", "ValueRange", "range_of", "restored", "value_range_of"]

AUTO: Final = "auto"
_MARGIN = 0.5  # of the span of a picture, beyond both ends


@dataclass(frozen=True, slots=True)
class ValueRange:
    """Values of images that become 0 and 1: x' = (x - low) / (high - low)."""

    low: float
    high: float

    @property
    def span(self) -> float:
        """Distance of the two."""
        return self.high - self.low

    def scaled(self, values: Pixels) -> Pixels:
        """Values as floats of which [0, 1] is the range; a copy, float32 of float32."""
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            if values.dtype == np.float32 and values.ndim == 4:  # image by image: less memory
                scaled = np.empty(values.shape, np.float32)
                for one, out in zip(values, scaled, strict=True):
                    out[...] = (one.astype(np.float64) - self.low) / self.span
                return scaled
            result: Pixels = (values.astype(np.float64) - self.low) / self.span
            return result.astype(np.float32) if values.dtype == np.float32 else result

    def restored(self, image: Float32) -> Float32:
        """Values that a user knows, of an image in [0, 1]."""
        return np.asarray(self.low + image.astype(np.float64) * self.span, np.float32)

    def __str__(self) -> str:
        return f"[{self.low:.6g}, {self.high:.6g}]"


def restored(image: Any, values: ValueRange | None) -> Any:
    """An image in [0, 1], or a list of them, in the user's values; None stays None."""
    if values is None or image is None:
        return image
    if isinstance(image, list):
        return [values.restored(one) for one in image]
    return values.restored(image)


def value_range_of(given: Any) -> ValueRange | str | None:
    """`value_range` as a user gives it: None, "auto", or two numbers.

    Raises OptionError (a ValueError) for anything else, and where the first is not the lower one.
    """
    if given is None or isinstance(given, ValueRange):
        return given
    if isinstance(given, str) and given == AUTO:
        return AUTO
    try:
        low, high = (_number(value) for value in given)
    except (TypeError, ValueError):
        raise OptionError(
            "value_range must be two numbers, the values that are black and white, such as "
            f'(0, 10), or "auto", not {given!r}'
        ) from None
    made = ValueRange(low, high)
    smallest = 1e-12 * max(abs(low), abs(high), 1e-280)
    if not (np.isfinite([low, high, made.span]).all() and made.span > smallest):
        raise OptionError(
            f"value_range must be two finite numbers, the lower one first, not {given!r}"
        )
    return made


def _number(value: Any) -> float:
    if isinstance(value, str | bytes | bool | np.bool_):
        raise TypeError("no number")
    return float(value)


def range_of(pictures: Iterable[tuple[Pixels, Mask | None]]) -> ValueRange:
    """Range for `value_range="auto"`: of the pictures, with half of their span beyond both ends.

    A picture without negative values has a range without them.  One of a single value c gets half
    of |c| beyond both ends, or 1/2 if c is 0.

    pictures: (H, W, C) each, and its hidden pixels (H, W).  Transparent ones do not count.
    Raises ImageError for NaN and infinity.
    """
    lows, highs = [], []
    for pixels, hidden in pictures:
        seen = np.ones(pixels.shape[:2], np.bool_) if hidden is None else ~hidden
        if pixels.shape[-1] == 4:
            seen = seen & (pixels[..., 3] > 0)
        values = pixels[..., :3][seen]
        if values.size:
            lows.append(float(values.min()))
            highs.append(float(values.max()))
    if not np.isfinite(lows + highs).all():
        raise ImageError(
            'value_range="auto" needs a target without NaN and infinity; mend it, hide these '
            "pixels by mask=, or give two numbers, value_range=(low, high)"
        )
    low, high = min(lows, default=0.0), max(highs, default=1.0)
    margin = _MARGIN * ((high - low) or abs(low) or 1.0)
    return ValueRange(max(0.0, low - margin) if low >= 0 else low - margin, high + margin)
