"""Saving by state, for baselines whose decisions take too long to be made again."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline
from fide_plugins.population import Population
from fide_plugins.runtime.schema import Schema, anything, array, check, maybe

__all__ = ["Stateful"]


class Stateful(Baseline):
    """A baseline that is saved as what it knows; subclasses say what that is."""

    own_schema: ClassVar[dict[str, Schema]]
    """What `_own_state` looks like; sides: d, k = popsize, f = features of an image."""

    @abstractmethod
    def _own_state(self) -> dict[str, Any]:
        """Everything that `_sample` and `_update` change."""

    @abstractmethod
    def _load_own_state(self, state: dict[str, Any]) -> None:
        """Put back what `_own_state` gave; tensors have become arrays."""

    def _search_state(self) -> dict[str, Any]:
        told = self._told_features
        return {
            "own": self._own_state(),
            "population": self._population.state_dict(),
            "features_of": np.array(list(told), np.int64),
            "features": np.array(list(told.values()), np.float32) if told else None,
        }

    def _load_search_state(self, state: dict[str, Any]) -> None:
        sides = self._sides()
        check(state, {**_SCHEMA, "own": self.own_schema}, sides)
        self._load_own_state(state["own"])
        self._population = Population.from_state(state["population"], self.dim)
        rows = () if state["features"] is None else state["features"]
        self._told_features = dict(zip(state["features_of"].tolist(), rows, strict=True))


_SCHEMA: dict[str, Schema] = {
    "population": anything,  # checks its own
    "features_of": array("told", kind="i"),
    "features": maybe(array("told", "f")),
}
