"""Renders beyond [0, 1]: an overshoot, which is clipped, or another scale, which ends the run.

One image does not tell the two apart: a highlight is brighter than white, and a dark picture in
[0, 255] may be darker than 1.  So a run counts, over all of its renders that go beyond 1, the
values that are not black (above 0.05), those of them above 1, and the mean of the latter.  Renders
are on another scale than the target where most of what is not black is above 1, and above 8 on
average; or where an image holds nothing but whole numbers, up to more than 2 and at most 255.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeAlias

from fide_plugins.errors import ValueRangeError
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.schema import Schema, check, flag, real, whole

__all__ = ["LIT", "Clip", "Clipping", "OnClip", "warn_clipped"]

LIT = 0.05
"""Values from here on are not black."""
_MOST = 0.5  # of these, that may be above 1 where they are large
_LARGEST_MEAN = 8.0  # of the values above 1


@dataclass(frozen=True, slots=True)
class Clip:
    """Values outside of the range in the images of one call; `str` of it is what a user is told.

    images: how many have such values.
    low, high: extremes of all of them, in the user's values.
    lit, above: values above 0.05 and above 1 in these images, counted after scaling; total: sum of
        the latter.
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

    def joined(self, others: list[Clip]) -> Clip:
        """One for this and further images; the message is that of the first."""
        every = [self, *others]
        more = f" (and {len(others)} more images)" if others else ""
        return Clip(
            self.message + more,
            sum(one.images for one in every),
            min(one.low for one in every),
            max(one.high for one in every),
            sum(one.lit for one in every),
            sum(one.above for one in every),
            sum(one.total for one in every),
        )

    def of_view(self, view: int) -> Clip:
        """The same, saying of which view."""
        return replace(self, message=f"view {view}: {self.message}")


OnClip: TypeAlias = Callable[[Clip], object]
"""What is called, once a batch, where values were clipped; it may raise ValueRangeError."""


@dataclass(slots=True)
class Clipping:
    """What a run has clipped so far; called with each `Clip`.

    images: clipped ones.  low, high: extremes of their values, 0 and 1 before the first one.
    lit, above, total: as of `Clip`, of all of them.
    """

    images: int = 0
    low: float = 0.0
    high: float = 1.0
    lit: int = 0
    above: int = 0
    total: float = 0.0
    warned: bool = False

    def __call__(self, clip: Clip) -> None:
        """Count images; warns of the first ones.

        Raises ValueRangeError, before anything changes, if the run is on another scale.
        """
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

    def copy(self) -> Clipping:
        """The same, to be changed in a step that may fail."""
        return replace(self)

    def state_dict(self) -> dict[str, Any]:
        """Everything."""
        return asdict(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Clipping:
        """What `state_dict` gave; raises ValueError for what it cannot have given."""
        check(state, _SCHEMA, {}, "clipping")
        return cls(**state)


_SCHEMA: dict[str, Schema] = {
    "images": whole(),
    "low": real(),
    "high": real(),
    "lit": whole(),
    "above": whole(),
    "total": real(),
    "warned": flag,
}


def warn_clipped(clip: Clip) -> None:
    """Issue what `clip` says as a RuntimeWarning; the default of `as_batch(on_clip=...)`.

    Raises ValueRangeError for images on another scale.
    """
    Clipping()(clip)
