"""What a check has found."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, Literal

from fide_plugins.fitting.checking.pixels import Difference
from fide_plugins.fitting.checking.values import Sweep
from fide_plugins.types import Float32

_REAL = re.compile(r"-?\d*\.\d+(e[-+]?\d+)?")

__all__ = ["Effect", "Facts", "Failure", "Where"]

Where = Literal["center", "elsewhere", "nowhere", "unknown"]
"""Where a parameter changes the image; unknown: too few of its renders gave one."""


@dataclass(eq=False)
class Effect:
    """What one parameter does.

    pictures: (h, w, 3) of its values, reduced; None where the render failed.
    change: largest difference of two of them; None if there are no two.
    ends_alike: whether its low and its high value give the same image, and the middle another one.
    """

    sweep: Sweep
    pictures: list[Float32 | None]
    change: Difference | None
    where: Where
    ends_alike: bool


@dataclass
class Failure:
    """Renders that gave no image for one reason.

    reason: in one line; details: of the first; params: its parameters, in a line.
    """

    reason: str
    details: str
    params: str
    count: int = 1

    @property
    def kind(self) -> tuple[str, str]:
        """What failures of one kind share: the message, but for the real numbers in it."""
        end = self.details.rpartition("\n")[2]  # of a traceback, or of what a program printed
        return _REAL.sub("", self.reason), _REAL.sub("", end)


@dataclass(eq=False)
class Facts:
    """What a check has found.

    dim: axes of the search.  parameters: that can vary.  renders: how many were made.
    repeated: whether some are of things of one kind, which then have random values at the center.
    images: how many of them gave an image.  rejected: points that violate constraints.
    center: parameters of the point around which the others vary; `centered`: it is the middle.
    shapes: those that occurred, each of all views, in the order in which they were seen.
    kinds: types of numbers that occurred.  low, high: of all values.
    not_finite, constant, outside: numbers of images with NaN or infinite values, of one color, and
        with values below 0 or above 1.
    first, alone, slowest: seconds of the first render; of one at the center, alone, later; longest.
    median: seconds of all but the first.
    together, number: seconds of as many renders at a time, each; None where one is too fast.
    noise: largest difference of two renders of one point; None if there are no two.
    drifts: whether renders of the center at the end differ from the first ones by more than these
        from each other.
    points: at how many points parameters were tried that change nothing at the center.
    kills: whether a render ended its process, or was stopped for its time.
    """

    dim: int
    parameters: int
    repeated: bool = False
    renders: int = 0
    images: int = 0
    rejected: int = 0
    center: dict[str, Any] | str = ""
    centered: bool = True
    shapes: list[tuple[tuple[int, ...], ...]] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    low: float = float("inf")
    high: float = float("-inf")
    not_finite: int = 0
    constant: int = 0
    outside: int = 0
    first: float = 0.0
    alone: float = 0.0
    median: float = 0.0
    slowest: float = 0.0
    together: float | None = None
    number: int = 1
    noise: Difference | None = None
    drifts: bool = False
    points: int = 0
    kills: bool = False
    effects: list[Effect] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def failed(self) -> int:
        """Renders that gave no image."""
        return sum(one.count for one in self.failures)

    @property
    def silent(self) -> list[str]:
        """Names of parameters that change nothing anywhere."""
        return [one.sweep.name for one in self.effects if one.where == "nowhere"]

    @property
    def ignores_all(self) -> bool:
        """Whether no parameter changes the image."""
        return bool(self.effects) and len(self.silent) == len(self.effects)

    @property
    def bytes_as_floats(self) -> bool:
        """Whether the values are floats that look like 0 to 255."""
        low, high = _LOOKS_LIKE_BYTES
        return low <= self.high <= high and self.low >= -0.1 * self.high

    @property
    def black(self) -> float:
        """Lower end of the range in which images are shown."""
        return 0.0 if self.bytes_as_floats or self.low >= -_OVERSHOOT else self.low

    @property
    def white(self) -> float:
        """Upper end of it: 1 where values lie in [0, 1]."""
        if self.bytes_as_floats:
            return 255.0
        return 1.0 if self.high <= 1 + _OVERSHOOT else self.high

    @property
    def span(self) -> float:
        """Width of it, in which differences are told."""
        return self.white - self.black


_LOOKS_LIKE_BYTES = 32.0, 280.0  # largest value; a picture up to 10 is one of high range
_OVERSHOOT = 0.5  # of [0, 1]: a renderer that overshoots is none of another range
