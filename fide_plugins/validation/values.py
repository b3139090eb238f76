"""Values of images: their types, which of them are black and white, and what lies beyond."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import ImageError, OptionError, ValueRangeError
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.schema import (
    flag,
    real,
    saved,
    whole,
)
from fide_plugins.types import Float32, Mask

Pixels: TypeAlias = npt.NDArray[Any]
MAX_PIXELS = 2**26
"""Most pixels an image file may decode to (67 megapixels, 0.8 GB as float32)."""


def describe(pixels: Any) -> str:
    """Shape and dtype of an array or a tensor, for errors."""
    return f"shape {tuple(pixels.shape)}, dtype {str(pixels.dtype).removeprefix('torch.')}"


def typed(array: Pixels, what: str, got: str, raw: bool = False) -> Pixels:
    """The array; ImageError unless its type says which value is white; raw: unless it has numbers.

    For whole numbers, whose scale is unknown, a ValueRangeError: all renders of a run have it.
    """
    if array.dtype == np.uint8 or array.dtype.kind in ("fbiu" if raw else "fb"):
        return array
    rule = f"{what} must be uint8 in [0, 255], bool, or floating in [0, 1], got {got}"
    if array.dtype.kind not in "iu" or not array.ndim:
        raise ImageError(f"{rule}; give an array of numbers, a path, a PIL image or a torch tensor")
    raise ValueRangeError(
        f"{rule}; divide by the value that is white, for example image / 65535, or give "
        "value_range, for example (0, 65535)"
    )


# -- which values are black and white: 0 and 1, or the two numbers of a user's `value_range` -------

AUTO: Final = "auto"


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
            result: Pixels = (values.astype(np.float64) - self.low) / self.span
            return result.astype(np.float32) if values.dtype == np.float32 else result

    def restored(self, image: Float32) -> Float32:
        """Values that a user knows, of an image in [0, 1]."""
        return np.asarray(self.low + image.astype(np.float64) * self.span, np.float32)

    def __str__(self) -> str:
        return f"[{self.low:.6g}, {self.high:.6g}]"


def restored(image: Any, values: ValueRange | None) -> Any:
    """An image in [0, 1], or a list of them, in the user's values; None stays None."""
    if isinstance(image, list):
        return [restored(one, values) for one in image]
    return image if values is None or image is None else values.restored(image)


def value_range_of(given: Any) -> ValueRange | str | None:
    """`value_range` as a user gives it: None, "auto", or two numbers; OptionError otherwise."""
    if given is None or isinstance(given, ValueRange) or (isinstance(given, str) and given == AUTO):
        return given
    try:
        if any(isinstance(value, str | bytes | bool | np.bool_) for value in given):
            raise TypeError("no number")
        made = ValueRange(*map(float, given))
    except (TypeError, ValueError):
        made = ValueRange(0, 0)
    smallest = 1e-12 * max(abs(made.low), abs(made.high), 1e-280)
    if not (np.isfinite([made.low, made.high, made.span]).all() and made.span > smallest):
        raise OptionError(
            "value_range must be two finite numbers, the values that are black and white, the "
            f'lower one first, such as (0, 10), or "auto", not {given!r}'
        )
    return made


def range_of(pictures: Iterable[tuple[Pixels, Mask | None]]) -> ValueRange:
    """Range for `value_range="auto"`: of the pictures, with half of their span beyond both ends.

    A picture without negative values has a range without them.  The span of a single value c is
    |c|, or 1 if c is 0.  Hidden and transparent pixels do not count.  ImageError for NaN, infinity.
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
    margin = ((high - low) or abs(low) or 1.0) / 2
    return ValueRange(max(0.0, low - margin) if low >= 0 else low - margin, high + margin)


# -- renders beyond [0, 1]: an overshoot, which is clipped, or another scale, which ends the run ---
#
# One image does not tell the two apart.  So a run counts, over all of its renders that go beyond 1,
# the values that are not black, those of them above 1, and the mean of the latter.  Renders are on
# another scale than the target where most of what is not black is above 1, and above 8 on average;
# or where an image holds whole numbers only, up to more than 2 and at most 255.

_LIT = 0.05  # values from here on are not black
_MOST = 0.5  # of these, that may be above 1 where they are large
_LARGEST_MEAN = 8.0  # of the values above 1


@dataclass(frozen=True, slots=True)
class Clip:
    """Values outside of the range in the images of one call; `str` of it is what a user is told.

    images: how many have such values.  low, high: extremes, in the user's values.  lit, above:
    scaled values above 0.05 and above 1 in these images; total: sum of the latter.
    """

    message: str
    images: int
    low: float
    high: float
    lit: int
    above: int
    total: float

    def __str__(self) -> str:
        return self.message

    def joined(self, other: Clip) -> Clip:
        """One for this and further images; the message is that of the first."""
        counts = ("images", "lit", "above", "total")
        sums = {name: getattr(self, name) + getattr(other, name) for name in counts}
        return replace(self, low=min(self.low, other.low), high=max(self.high, other.high), **sums)

    def of_view(self, view: int) -> Clip:
        """The same, saying of which view."""
        return replace(self, message=f"view {view}: {self.message}")


OnClip: TypeAlias = Callable[[Clip], object]
"""What is called, once a batch, where values were clipped; it may raise ValueRangeError."""


@dataclass(slots=True)
class Clipping:
    """What a run has clipped so far, as `Clip` has it for a call; called with each `Clip`."""

    images: int = saved(whole(), default=0)
    low: float = saved(real(), default=0.0)
    high: float = saved(real(), default=1.0)
    lit: int = saved(whole(), default=0)
    above: int = saved(whole(), default=0)
    total: float = saved(real(), default=0.0)
    warned: bool = saved(flag, default=False)

    def __call__(self, clip: Clip) -> None:
        """Count images, with a warning of the first ones; ValueRangeError on another scale."""
        self.note(clip)
        if not self.warned:
            self.warned = True
            warn_user(clip.message)

    def note(self, clip: Clip) -> None:
        """Count images without a warning; raises as a call does."""
        lit, above, total = self.lit + clip.lit, self.above + clip.above, self.total + clip.total
        images, high = self.images + clip.images, max(self.high, clip.high)
        if above > _MOST * lit and total > _LARGEST_MEAN * above:
            which = "the image" if images == 1 else f"the {images:,} images that go beyond white"
            raise ValueRangeError(
                f"the renders are on another scale than the target: in {which}, {above / lit:.0%} "
                f"of what is not black is brighter than white, {total / above:.3g} times on "
                f"average (values up to {high:.6g}); multiply renders and target by the same "
                "number, so that white is 1, or give value_range=(low, high).  If they are on one "
                "scale, clip in the renderer, np.clip(image, 0, 1)"
            )
        self.images, self.high, self.low = images, high, min(self.low, clip.low)
        self.lit, self.above, self.total = lit, above, total


def warn_clipped(clip: Clip) -> None:
    """Issue what `clip` says as a RuntimeWarning; the default of `as_batch(on_clip=...)`.

    Raises ValueRangeError for images on another scale.
    """
    Clipping()(clip)


# -- telling of what lies beyond -------------------------------------------------------------------

ROUNDING = 1e-6
_LARGEST = 1e30  # of values that are added; there is no end to those of fireflies


def tell_clipped(
    seen: Pixels,
    extremes: tuple[float, float],
    about: str,
    what: str,
    on_clip: OnClip | None,
    values: ValueRange | None,
) -> None:
    """Tell `on_clip` of values beyond [0, 1] in n images: seen (n, values), and their extremes."""
    low, high = ends = extremes
    if values is not None:
        ends = values.low + low * values.span, values.low + high * values.span
    of_bytes = values is None and low >= 0.0 and 2.0 < high <= 255 + ROUNDING
    of_bytes = of_bytes and bool((seen == seen.round()).all())
    got, rule = f"values in [{ends[0]:.6g}, {ends[1]:.6g}], {about}", values or "[0, 1]"
    remedy = (
        f'give value_range=({min(0.0, ends[0]):.6g}, {max(1.0, ends[1]):.6g}) or "auto", in the '
        "shell --value-range, or divide target and renders by the same number; clip what is an "
        "overshoot"
    )
    if what.startswith(("mask", "weights")):
        remedy = "divide them by the largest"
    elif values is not None:
        remedy = "give a wider value_range, which target and renders share"
    elif of_bytes:
        remedy = "divide by 255, target and renders alike, or give value_range=(0, 255)"
    if on_clip is None or of_bytes:
        refused = ImageError if on_clip is None else ValueRangeError
        raise refused(f"{what} must have values in {rule}, got {got}; {remedy}")
    hint = f"; if they are no overshoot, {remedy}" if high > 2.0 or low < -1.0 else ""
    told = f"{what} has {got}; they are clipped to {rule}{hint}"
    beyond = (seen > 1.0 + ROUNDING).any(1)
    images = int((beyond | (seen < -ROUNDING).any(1)).sum())
    bright = seen[beyond]
    above = bright[bright > 1.0]
    total = float(above.clip(0.0, _LARGEST).sum())
    on_clip(Clip(told, images, *ends, int((bright > _LIT).sum()), above.size, total))
