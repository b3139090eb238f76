"""Whether a renderer's images can be learned from: most renders succeed, and they differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fide_plugins.errors import FideError, OptionError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.learning.renders.renderer import Pixels, Small
from fide_plugins.learning.renders.store import SHARD

__all__ = ["Tally", "all_equal", "too_few"]

_FEW = 500  # renders that say that a renderer must be mended


@dataclass
class Tally:
    """Counts what a renderer has made in this call.

    name: of the renderer.  failed: of each shard, how many renders.
    """

    name: str
    failed: dict[int, int] = field(default_factory=dict)
    _why: str = ""
    _first: Pixels | None = None
    _equal: bool = True

    def add(self, shard: int, images: Sequence[Small], failed: int) -> None:
        """Add a shard: its images, of which so many failed."""
        self.failed[shard] = failed
        reasons = (image.reason for image in images if isinstance(image, Failed))
        self._why = self._why or next(reasons, "")
        for image in images:
            if self._equal and not isinstance(image, Failed):
                self._first = image if self._first is None else self._first
                self._equal = np.array_equal(image, self._first)

    def check(self) -> None:
        """Raise RenderError where enough renders say that the renderer must be mended."""
        tried, failed = SHARD * len(self.failed), sum(self.failed.values())
        if tried < _FEW:
            return
        if 2 * failed > tried:
            raise RenderError(
                f"{self.name} failed for {failed} of {tried} random parameters, or gave no image: "
                f"mend it, or make the ranges of its parameters smaller; the first one: {self._why}"
            )
        if self.image is not None:
            raise all_equal(self.name, tried - failed)

    @property
    def image(self) -> Pixels | None:
        """The image (H, W, 3) that all renders are; None if they differ."""
        return self._first if self._equal else None

    @property
    def with_failures(self) -> list[int]:
        """Shards in which renders have failed."""
        return [shard for shard, failed in self.failed.items() if failed]


def all_equal(name: str, renders: int) -> RenderError:
    """Error of a renderer of that name whose images say nothing of its parameters."""
    return RenderError(
        f"the images of {name} for {renders} random parameters are all equal, in 8 bits and at the "
        "size that is learned: mend it, change the ranges of its parameters (what they change may "
        "be out of view), or give a larger size"
    )


def too_few(there: int, least: int, failed: int, renders: int) -> FideError:
    """Error that names what is missing: renders that succeed, renders at all, or time for them.

    there: renders, of which `least` are needed.  failed: other ones.  renders: asked for.
    """
    few = f"{there} renders are too few to learn from (at least {least})"
    if failed == 0:
        return OptionError(f"{few}; allow more time")
    return RenderError(
        f"{few}: {failed} of {there + failed} failed; mend the renderer, make the ranges of its "
        f"parameters smaller, or ask for more than {renders} renders"
    )
