"""The best point told so far, and where the search that asked it stood."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fide_plugins.runtime.schema import Schema, array, maybe, real, whole
from fide_plugins.types import Float64, Solution

__all__ = ["SCHEMA", "Best"]

SCHEMA: Schema = {
    "x": array("d", low=0.0, high=1.0),
    "loss": real(),
    "evaluation": whole(),
    "image": maybe(array("H", "W", 3, low=0.0, high=1.0)),
    "index": whole(),
    "mean": array("d", low=-1e60, high=1e60),
    "search_number": whole(),
}


@dataclass(frozen=True, slots=True)
class Best:
    """The best point told so far.

    solution: the point.
    index: number of its candidate.
    mean: (d,), mean of the search that asked it; the point itself if none did.
    search_number: of the search that asked it; 0 for none.
    """

    solution: Solution
    index: int
    mean: Float64
    search_number: int

    def state_dict(self) -> dict[str, Any]:
        """All of it but what is computed when it is read; arrays are those in use, not copies."""
        solution = self.solution
        return {
            "x": solution.x,
            "loss": solution.loss,
            "evaluation": solution.evaluation,
            "image": solution.image,
            "index": self.index,
            "mean": self.mean,
            "search_number": self.search_number,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Best:
        """Undo `state_dict`."""
        names = ("x", "loss", "evaluation", "image")
        solution = Solution(**{name: state[name] for name in names})
        return cls(solution, state["index"], state["mean"], state["search_number"])
