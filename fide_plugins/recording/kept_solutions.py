"""Solutions of a fit in `run.json`, with their standard deviations as they were at its end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fide_plugins.recording.parameters import is_rough
from fide_plugins.space import Space
from fide_plugins.types import Estimated, Float64, Solution

__all__ = ["read", "written"]


def written(solutions: Sequence[Solution]) -> list[dict[str, Any]]:
    """Solutions for JSON, without images."""
    return [
        {
            "x": one.x.tolist(),
            "loss": one.loss,
            "evaluation": one.evaluation,
            "std": None if one.std is None else [_number(value) for value in one.std.tolist()],
            "rough": is_rough(one),
            "ambiguous": _ambiguous(one),
            "probability": one.probability,
        }
        for one in solutions
    ]


def read(data: Any, dim: int, space: Space | None) -> list[Solution]:
    """Solutions of `dim` parameters that `written` gave; ValueError or TypeError for other data."""
    if not isinstance(data, list) or not all(isinstance(one, dict) for one in data):
        raise TypeError("its solutions are no list of objects")
    return [_solution(one, dim, space) for one in data]


def _solution(data: dict[str, Any], dim: int, space: Space | None) -> Solution:
    x = _numbers("x", data.get("x"), dim)
    if not (np.isfinite(x).all() and x.min(initial=0) >= 0 and x.max(initial=0) <= 1):
        raise ValueError("x of a solution lies outside of [0, 1]")
    std = None if data.get("std") is None else _numbers("std", data["std"], dim)
    ambiguous = data.get("ambiguous")
    if ambiguous is not None:
        ambiguous = _numbers("ambiguous", ambiguous, dim) > 0
    probability = data.get("probability")
    return Solution(
        x,
        float(data.get("loss", math.nan)),
        int(data.get("evaluation", -1)),
        probability=None if probability is None else float(probability),
        space=space,
        estimate=Estimated(std, ambiguous, data.get("rough") is True),
    )


def _numbers(name: str, values: Any, dim: int) -> Float64:
    """Numbers (dim,); None stands for NaN."""
    array = np.array([math.nan if value is None else float(value) for value in values])
    if array.shape != (dim,):
        raise ValueError(f"{name} of a solution has {len(array)} numbers, and there are {dim}")
    return array


def _ambiguous(one: Solution) -> list[bool] | None:
    known = None if one.estimate is None else one.estimate.ambiguous
    return None if known is None else known.tolist()


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
