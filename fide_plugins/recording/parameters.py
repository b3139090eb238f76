"""Values of parameters in their units, and how sure they are: as text, and in `run.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fide_plugins.renderers.naming import flat
from fide_plugins.space import Choice, Float, Kind, Space
from fide_plugins.types import Estimated, Solution

ROUGH = "± rough, from the search"
"""Remark on standard deviations that depend on the path of the search."""

_SMALL, _DIGITS = 1e-4, 9  # least number without an exponent, most digits behind the point


@dataclass(frozen=True)
class Row:
    """One parameter of several solutions.

    name: as `Space.names` has it; unit: "" without one.
    values: one text a solution, with its standard deviation if it is known.
    determined: False if the best solution says so, see `Solution.undetermined`.
    """

    name: str
    unit: str
    values: list[str]
    determined: bool = True

    @property
    def label(self) -> str:
        """Name with its unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def rows(solutions: Sequence[Solution]) -> list[Row]:
    """One row for each parameter of solutions of the same space (or all without one)."""
    if not solutions:
        return []
    space, first = solutions[0].space, solutions[0]
    known = space or Space(**{f"x{i}": Float(0, 1) for i in range(len(first.x))})
    table, params = [], [dict(flat(known.decode(one.x))) for one in solutions]
    for i, (name, kind) in enumerate(known.parameters.items()):
        axes, values = known.axes[name], []
        for solution, given in zip(solutions, params, strict=True):
            std = None if solution.std is None or len(axes) != 1 else float(solution.std[axes[0]])
            scaled = None if std is None else _in_units(kind, given[name], std)
            values.append(_text(given[name], scaled))
        name = f"x[{i}]" if space is None else name
        table.append(Row(name, kind.unit or "", values, name not in first.undetermined))
    return table


def is_rough(solution: Solution) -> bool:
    """Whether it has standard deviations that are by samples of the search only."""
    known = solution.estimate
    return known is not None and known.rough and solution.std is not None


def described(solution: Solution) -> str:
    """Parameters of a solution in one line of text: ``azimuth=12.30 ± 0.05 deg, rows=3``."""
    pairs = [(f"{row.name}={row.values[0]}", row.unit) for row in rows([solution])]
    return ", ".join(f"{text} {unit}" if unit else text for text, unit in pairs)


def lines(solution: Solution, most: int) -> list[str]:
    """The same, a line for each parameter in columns, at most so many: ``azimuth  12.3 deg``."""
    table = rows([solution])
    width = max((len(row.name) for row in table[:most]), default=0)
    shown = [f"{row.name:{width}}  {row.values[0]} {row.unit}".rstrip() for row in table[:most]]
    more = len(table) - most
    if more > 0:
        shown.append(f"... {more} more")
    if is_rough(solution) and any("±" in row.values[0] for row in table):
        shown.append(ROUGH)
    return shown


def _in_units(kind: Kind, value: Any, std: float) -> float | None:
    """Standard deviation of a value, from that of its coordinate; None for a choice."""
    if isinstance(kind, Choice):
        return None
    low, high, step, log = kind.scale
    if log:  # d value / d x, with x linear in the logarithm
        return std * float(value) * math.log((high + step / 2) / (low - step / 2))
    return std * (high - low + step)


def _text(value: Any, std: float | None) -> str:
    """Text of a value: digits down to the second one of its standard deviation.

    Numbers below 1e-4 have an exponent, and so has a deviation below the ninth digit of its value.

    >>> _text(25.0321, 0.0871), _text(0.02, None), _text(6, 0.3), _text("checker", None)
    ('25.032 ± 0.087', '0.02', '6 ± 0.30', 'checker')
    >>> _text(3.2e-10, 1e-12), _text(0.5, 1e-12)
    ('3.200e-10 ± 1.0e-12', '0.500000000 ± 1.0e-12')
    """
    if std is None or not np.isfinite(std):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    digits = max(0, 1 - math.floor(math.log10(std))) if std > 0 else 4
    fine = digits > _DIGITS
    if isinstance(value, float) and max(abs(value), std) < _SMALL and (value or std):
        fine = True
        above = math.floor(math.log10(abs(value) / std)) if value and std else 2
        shown = f"{value:.{min(max(above, 0) + 1, _DIGITS)}e}" if value else "0"
    else:
        digits = min(digits, _DIGITS)
        shown = f"{value:.{digits}f}" if isinstance(value, float) else str(value)
    return f"{shown} ± {std:.1e}" if fine and std else f"{shown} ± {std:.{digits}f}"


def solutions_as_data(solutions: Sequence[Solution]) -> list[dict[str, Any]]:
    """Solutions for JSON, without images."""

    def listed(values: Any) -> list[Any] | None:
        if values is None:
            return None
        return [None if one != one else one for one in values.tolist()]  # NaN is no JSON

    return [
        {
            "x": one.x.tolist(),
            "loss": one.loss,
            "evaluation": one.evaluation,
            "std": listed(one.std),
            "rough": is_rough(one),
            "ambiguous": listed(None if one.estimate is None else one.estimate.ambiguous),
            "probability": one.probability,
        }
        for one in solutions
    ]


def with_std(solutions: list[Solution], run: Mapping[str, Any]) -> list[Solution]:
    """The same, the best one with the standard deviations that `run.json` of its fit has."""
    kept = (run.get("totals") or {}).get("solutions") or [{}]
    if not solutions or kept[0].get("x") != solutions[0].x.tolist():
        return solutions
    numbers = {}
    for name in ("std", "ambiguous"):
        listed = kept[0].get(name)
        if listed is not None:
            listed = np.array([math.nan if one is None else float(one) for one in listed])
            if listed.shape != solutions[0].x.shape:
                raise ValueError(f"{name} of a solution has {len(listed)} numbers")
        numbers[name] = listed
    ambiguous = None if numbers["ambiguous"] is None else numbers["ambiguous"] > 0
    known = Estimated(numbers["std"], ambiguous, kept[0].get("rough") is True)
    return [replace(solutions[0], estimate=known), *solutions[1:]]
