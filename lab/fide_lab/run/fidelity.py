"""Renders with few samples per pixel at first, and more as noise requires; see `pixel_samples`.

Losses at different numbers of samples are not comparable.  So when the number has risen, the best
candidate so far is rendered again, together with the next candidates, before one of them can
replace it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_lab.run.pixel_samples import PixelSamples
from fide_lab.run.task import TaskInfo
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32, Float64

if TYPE_CHECKING:
    from fide_plugins.recording.record import Record

__all__ = ["Fidelity"]


class Fidelity:
    """Renders candidates with the number of samples that `PixelSamples` chooses.

    task: has an attribute `spp`, the largest number of samples, which its `render` uses.
    least: initial number of samples per pixel.

    Raises OptionError (a ValueError) for a task without `spp`, or with fewer than `least`.
    """

    def __init__(self, task: Any, least: int) -> None:
        info = TaskInfo.of(task)
        if not isinstance(info.spp, int):
            raise OptionError(
                f"least_spp is for tasks that take samples of a pixel (spp), and {info.name} takes "
                "none: leave it out"
            )
        self.rule = PixelSamples(least, info.spp)
        self._task = task
        self._level = 0  # samples of the best candidate's render
        self.total = 0
        """Sum of the samples per pixel of all renders so far."""

    def render(self, X: Float64, seed: Sequence[int]) -> Any:
        """Images of candidates (n, dim)."""
        self._task.spp = self.rule.number
        try:
            return self._task.render(X, seed=seed)
        finally:
            self._task.spp = self.rule.most

    def extra_points(self, X: Float64, record: Record) -> Float64:
        """Points (m, dim) to render in addition to X: the best candidate, the first of X."""
        best = [] if record.x_best is None or not self._has_risen else [record.x_best]
        return np.array([*best, *X[: int(self.rule.pair_due)]]).reshape(-1, X.shape[1])

    def note(
        self, record: Record, losses: Float64, images: Float32, others: Float64, more: bool = False
    ) -> None:
        """Record losses of candidates (n,), and images and losses (m,) of the `extra_points`.

        To be called before the record gets the candidates.
        more: whether others follow that were asked with them.  An optimizer that hands out the two
            parts of a generation one after the other (`FIDE.ask_ready`) may have a number for each.
        """
        self.total += self.rule.number * (len(losses) + len(others))
        if self._has_risen and record.x_best is not None:
            record.judge_again(images[0], float(others[0]))
            others = others[1:]
        self._level = self.rule.number
        self.rule.note(losses, float(others[0]) if len(others) else None, more=more)

    @property
    def _has_risen(self) -> bool:
        return self._level < self.rule.number

    def state_dict(self) -> dict[str, Any]:
        """The evolving state; `recording.record_schema` says what it must look like."""
        return {"rule": self.rule.state_dict(), "level": self._level, "total": self.total}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state that `state_dict` returned."""
        self.rule.load_state_dict(state["rule"])
        self._level, self.total = int(state["level"]), int(state["total"])
