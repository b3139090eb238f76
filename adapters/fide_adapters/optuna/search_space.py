"""Optuna's search spaces as a `fide_plugins.Space`, and which parameters are searched together.

=================================  =================================================================
distribution                       parameter of the space
=================================  =================================================================
float; int with `log`              `Float`; `Int` with log
int, or float with a step          `Int`, the number of steps from the lowest value
n choices                          `Choice` of their indices; `Int` if there are more than 1,000
one value only                     none
=================================  =================================================================

Where doubles cannot tell the values or the logarithms apart, a `Float` without that is used.

Parameters are ordered by name: alphabetically, but x2 before x10.

Searched together, in Optuna's words the relative search space, are the parameters that each of the
last ten completed trials had, with the same distribution.  So a parameter that some trials lack,
or whose range keeps changing, is left to the independent sampler; one that has changed once is
searched again ten trials later.  If a study changes too often, only the parameters that all of its
trials had are searched.

Before any trial has completed, the parameters that the first running trial has so far are searched,
so that workers that start at the same time, and trials that are asked in a batch, get candidates of
one generation.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import SpaceError
from fide_plugins.space import Choice, Float, Int, Kind, Space
from fide_plugins.types import Float64

__all__ = ["RelativeSpace", "SearchSpace"]

Distributions = Mapping[str, BaseDistribution]

_MOST_CHOICES = 1000  # of a `Choice`
_RECENT = 10  # trials
_MOST_SPACES = 8


def _by_name(name: str) -> tuple[tuple[str, int], ...]:
    """Key to sort names by: as text, but the whole numbers in them as numbers.

    >>> sorted(["x10", "x9", "a"], key=_by_name)
    ['a', 'x9', 'x10']
    """
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
    """Distributions by name as a `Space`, and the values of trials as points of its cube.

    space: of those with several values; None if there are none.
    dim: number of its axes.
    """

    def __init__(self, distributions: Distributions) -> None:
        ordered = sorted(distributions, key=_by_name)
        self.distributions = {name: distributions[name] for name in ordered}
        varied = {n: d for n, d in self.distributions.items() if not d.single()}
        self._names = list(varied)
        parameters = [_Parameter.of(name, d) for name, d in varied.items()]
        self._converted = [(i, one) for i, one in enumerate(parameters) if not one.is_plain]
        kinds = {f"p{i}": one.kind for i, one in enumerate(parameters)}
        self.space = Space(kinds) if kinds else None
        self.dim = 0 if self.space is None else self.space.dim
        self._fixed = {n: _only(d) for n, d in self.distributions.items() if d.single()}
        ranges: dict[str, Any] = {n: d for n, d in self.distributions.items() if hasattr(d, "low")}
        self._ranged = list(ranges)
        self._low = np.array([d.low for d in ranges.values()], np.float64)
        self._high = np.array([d.high for d in ranges.values()], np.float64)
        self._choices = {n: d for n, d in self.distributions.items() if n not in ranges}

    def decode(self, x: Float64) -> dict[str, Any]:
        """Parameters of a point x (dim,), as native numbers and choices."""
        numbers = [] if self.space is None else self.space.layout.numbers(x[None])[0].tolist()
        for i, one in self._converted:
            numbers[i] = one.value(numbers[i])
        params = dict(zip(self._names, numbers, strict=True)) | self._fixed
        return {name: params[name] for name in self.distributions} if self._fixed else params

    def encode(self, params: Mapping[str, Any]) -> Float64:
        """Point (dim,) of the parameters of a trial in this space."""
        numbers = [params[name] for name in self._names]
        for i, one in self._converted:
            numbers[i] = one.number(numbers[i])
        if self.space is None:
            return np.empty(0)
        point: Float64 = self.space.layout.points(np.array([numbers], np.float64))[0]
        return point

    def snap(self, x: Float64) -> Float64:
        """Point (dim,) that encodes the parameters of a point x (dim,)."""
        if self._converted or self.space is None:
            return self.encode(self.decode(x))
        layout = self.space.layout
        point: Float64 = layout.points(layout.numbers(x[None]))[0]
        return point

    def holds(self, trial: FrozenTrial) -> bool:
        """Whether the trial has all of these parameters, of these kinds and within these ranges."""
        params, kinds, own = trial.params, trial.distributions, self.distributions
        same_kinds = all(name in params and type(kinds[name]) is type(own[name]) for name in own)
        return same_kinds and self.contains(params)

    def contains(self, params: Mapping[str, Any]) -> bool:
        """Whether each of these parameters has a value, within its range."""
        if not all(name in params for name in self.distributions):
            return False
        try:
            values = np.array([params[name] for name in self._ranged], np.float64)
            for name, distribution in self._choices.items():
                distribution.to_internal_repr(params[name])  # a NaN is a NaN
        except (TypeError, ValueError):  # of an enqueued trial, which Optuna refuses
            return False
        return bool(((values >= self._low) & (values <= self._high)).all())


def _only(distribution: Any) -> Any:
    """Value of a distribution that has only one."""
    choices = getattr(distribution, "choices", None)
    return choices[0] if choices else distribution.low


class RelativeSpace:
    """Which parameters are searched together, according to recent trials.

    warnings: where a change of the space is logged.
    """

    def __init__(self, warnings: WarnOnce) -> None:
        self.completed = 0
        """Completed trials added so far."""
        self._warnings = warnings
        self._recent: deque[Distributions] = deque(maxlen=_RECENT)
        self._always: dict[str, BaseDistribution] | None = None
        self._spaces: list[dict[str, BaseDistribution]] = []
        self._current: dict[str, BaseDistribution] = {}

    def add(self, trial: FrozenTrial) -> None:
        """Add a finished trial."""
        if trial.state is not TrialState.COMPLETE:
            return
        self.completed += 1
        seen = trial.distributions
        last = self._recent[-1] if self._recent else None
        same = last is not None and seen == last
        self._recent.append(last if same and last is not None else seen)
        if not same:
            self._always = _common([seen if self._always is None else self._always, seen])
        if not same or len(set(map(id, self._recent))) > 1 or not self._current:
            self._decide()

    def begin(self, running: Distributions) -> None:
        """Use the parameters of a running trial while no trial has completed."""
        if not self.completed:
            self._current = _common([running])

    @property
    def current(self) -> dict[str, BaseDistribution]:
        """Distributions by name, in order; empty if none are known."""
        return self._current

    def _decide(self) -> None:
        space = _common(list(self._recent))
        if space not in self._spaces:
            if len(self._spaces) == 1:
                self._warnings.log(
                    "space",
                    "the search space of the study has changed; parameters that have not been the "
                    f"same in the last {_RECENT} trials are sampled independently",
                )
            if len(self._spaces) < _MOST_SPACES:
                self._spaces.append(space)
            else:
                space = self._always or {}
        self._current = space


def _common(several: list[Distributions]) -> dict[str, BaseDistribution]:
    """Parameters that are the same in all of them and have more than one value."""
    first, *others = several
    names = [n for n in sorted(first, key=_by_name) if not first[n].single()]
    distinct = {id(other): other for other in others if other is not first}.values()
    return {n: first[n] for n in names if all(o.get(n) == first[n] for o in distinct)}
