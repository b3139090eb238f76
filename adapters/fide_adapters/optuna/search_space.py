"""Optuna's search spaces as a `fide_plugins.Space`.

=================================  =================================================================
distribution                       parameter of the space
=================================  =================================================================
float; int with `log`              `Float`; `Int` with log
int, or float with a step          `Int`, the number of steps from the lowest value
n choices                          `Choice` of their indices; `Int` if there are more than 1,000
=================================  =================================================================

Where doubles cannot tell the values or the logarithms apart, a `Float` without that is used.
Parameters are ordered by name: alphabetically, but x2 before x10.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from optuna.trial import FrozenTrial

from fide_plugins.errors import SpaceError
from fide_plugins.space import Choice, Float, Int, Kind, Space
from fide_plugins.types import Float64

Distributions = Mapping[str, BaseDistribution]

_MOST_CHOICES = 1000  # of a `Choice`


def common(one: Distributions, other: Distributions) -> dict[str, BaseDistribution]:
    """Parameters of several values that are the same in both, in the order of a `SearchSpace`."""
    names = [n for n in sorted(one, key=_by_name) if one[n] == other.get(n)]
    return {name: one[name] for name in names if not one[name].single()}


def _by_name(name: str) -> tuple[tuple[str, int], ...]:
    """Key to sort names by: as text, but the whole numbers in them as numbers."""
    parts = re.split(r"([0-9]+)", name)  # text and numbers in turn
    return tuple((t, int(n or 0)) for t, n in zip(parts[::2], [*parts[1::2], ""], strict=True))


@dataclass(frozen=True)
class _Parameter:
    """A distribution of several values: value = origin + step * number, numbers are of the kind."""

    distribution: Any
    kind: Kind
    origin: Any = 0
    step: Any = 1

    @classmethod
    def of(cls, name: str, d: Any) -> _Parameter:
        """Parameter of a distribution; raises SpaceError for a range whose length is no double."""
        if isinstance(d, CategoricalDistribution):
            n = len(d.choices)
            return cls(d, Choice(*range(n)) if n <= _MOST_CHOICES else Int(0, n - 1))
        if not isfinite(d.high - d.low):
            raise SpaceError(
                f"parameter {name!r}, from {d.low} to {d.high}: high - low must be finite; take a "
                "narrower range"
            )
        if d.log:
            for kind in (Int, Float) if isinstance(d, IntDistribution) else (Float,):
                with suppress(SpaceError):  # doubles do not tell the logarithms apart
                    return cls(d, kind(d.low, d.high, log=True))
        if d.step is None:
            return cls(d, Float(d.low, d.high))
        steps = round((d.high - d.low) / d.step)
        with suppress(SpaceError):  # too many values
            return cls(d, Int(0, steps), d.low, d.step)
        return cls(d, Float(0, steps), d.low, d.step)

    @property
    def is_plain(self) -> bool:
        """Whether values are numbers."""
        return not isinstance(self.distribution, CategoricalDistribution) and not (
            self.distribution.step
        )

    def value(self, number: float) -> Any:
        """Value of a number, native."""
        d = self.distribution
        if isinstance(d, CategoricalDistribution):
            return d.choices[int(number)]
        return min(max(self.origin + self.step * round(number), d.low), d.high)

    def number(self, value: Any) -> float:
        """Number of a value within the range."""
        if isinstance(self.distribution, CategoricalDistribution):
            return self.distribution.to_internal_repr(value)
        return float(round((value - self.origin) / self.step))


class SearchSpace:
    """Distributions of several values by name, and the values of trials as points of a cube.

    space: its parameters are called p0, p1, ... in the order of the names.
    """

    def __init__(self, distributions: Distributions) -> None:
        self.distributions = common(distributions, distributions)
        parameters = [_Parameter.of(name, d) for name, d in self.distributions.items()]
        self._converted = [(i, one) for i, one in enumerate(parameters) if not one.is_plain]
        self.space = Space({f"p{i}": one.kind for i, one in enumerate(parameters)})

    def decode(self, x: Float64) -> dict[str, Any]:
        """Parameters of a point x (dim,), as native numbers and choices."""
        numbers = self.space.layout.numbers(x[None])[0].tolist()
        for i, one in self._converted:
            numbers[i] = one.value(numbers[i])
        return dict(zip(self.distributions, numbers, strict=True))

    def encode(self, params: Mapping[str, Any]) -> Float64:
        """Point (dim,) of the parameters of a trial in this space."""
        numbers = [params[name] for name in self.distributions]
        for i, one in self._converted:
            numbers[i] = one.number(numbers[i])
        point: Float64 = self.space.layout.points(np.array([numbers], np.float64))[0]
        return point

    def snap(self, x: Float64) -> Float64:
        """Point (dim,) that encodes the parameters of a point x (dim,)."""
        return self.encode(self.decode(x))

    def holds(self, trial: FrozenTrial) -> bool:
        """Whether the trial has all of these parameters, of these kinds and within these ranges."""
        kinds = trial.distributions
        same = all(type(kinds.get(name)) is type(d) for name, d in self.distributions.items())
        return same and self.contains(trial.params)

    def contains(self, params: Mapping[str, Any]) -> bool:
        """Whether each of these parameters has a value, within its range."""
        try:
            for name, d in self.distributions.items():
                number = d.to_internal_repr(params[name])  # a ValueError for no choice
                plain: Any = None if isinstance(d, CategoricalDistribution) else d
                if plain is not None and not plain.low <= number <= plain.high:
                    return False
        except (KeyError, OverflowError, TypeError, ValueError):  # Optuna refuses it, too
            return False
        return True
