"""Saving by replay: a checkpoint holds what was asked and told, and loading runs it again.

A baseline is a function of its seed and of what it was asked and told.  Nothing of a library's
inner state has to be stored, so any library will do.  Loading takes as long as all its decisions
took.
"""

from __future__ import annotations

from array import array as numbers
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline
from fide_plugins.population import Candidate
from fide_plugins.runtime.schema import Schema, array, check, maybe
from fide_plugins.types import Float32, Float64

__all__ = ["Replayed"]

_INJECTED = -1


class Replayed(Baseline):
    """A baseline that is saved as the history of its run."""

    keeps_features: ClassVar[bool] = True
    """Whether the history holds the features of images, for the replay."""

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        # -(n + 1): n > 0 candidates were asked; i >= 0: candidate i was told; -1: an injected one.
        self._events = numbers("q")
        self._losses = numbers("d")  # told
        self._injected = numbers("d")  # points told that were not pending
        self._history: list[Float32] = []  # features told

    def _hand_out(self, n: int | None) -> list[Candidate]:
        handed_out = super()._hand_out(n)
        self._events.append(-(len(handed_out) + 1))
        return handed_out

    def _record(
        self, x: Float64, loss: float, image: Float32 | None, features: Float32 | None
    ) -> int | None:
        index = super()._record(x, loss, image, features)
        self._events.append(_INJECTED if index is None else index)
        self._losses.append(loss)
        if index is None:
            self._injected.extend(x.tolist())
        if features is not None and self.keeps_features:
            self._history.append(features)
        return index

    def _search_state(self) -> dict[str, Any]:
        return {
            "events": np.array(self._events, np.int64),
            "losses": np.array(self._losses, np.float64),
            "injected": np.array(self._injected, np.float64).reshape(-1, self.dim),
            "features": np.array(self._history, np.float32) if self._history else None,
        }

    def _keep_history(self, state: dict[str, Any]) -> None:
        """Take over a history without asking and telling it again."""
        self._events = numbers("q", _checked_events(state, self._sides()))
        self._losses = numbers("d", state["losses"].tolist())
        self._injected = numbers("d", state["injected"].ravel().tolist())

    def _load_search_state(self, state: dict[str, Any]) -> None:
        """Ask and tell what the saved baseline was asked and told."""
        events = _checked_events(state, self._sides())
        pending: dict[int, Float64] = {}
        injected, losses = iter(state["injected"]), iter(state["losses"].tolist())
        features = iter(() if state["features"] is None else state["features"])
        for event in events:
            if event < _INJECTED:
                pending |= {c.index: c.x for c in self._hand_out(-event - 1)}
            else:
                x = next(injected) if event == _INJECTED else pending.pop(event)
                self._record(x, next(losses), None, next(features, None))


def _checked_events(state: dict[str, Any], sides: dict[str, int]) -> list[int]:
    """The events of a history; ValueError unless losses, points and features fit them."""
    check(state, _SCHEMA, sides, "history")
    events: list[int] = state["events"].tolist()
    told, injected = sum(event >= _INJECTED for event in events), events.count(_INJECTED)
    if (told, injected) != (len(state["losses"]), len(state["injected"])):
        raise ValueError(f"a history of {told} results, {injected} of them injected, lacks some")
    return events


_SCHEMA: Schema = {
    "events": array("e", kind="i", low=None),
    "losses": array("t", low=None),
    "injected": array("n", "d", low=0.0, high=1.0),
    "features": maybe(array("t", "f")),
}
