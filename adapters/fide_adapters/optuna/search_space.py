"""Optuna's search spaces: as a unit cube, and which parameters are searched together.

=======================  ======  ===================================================================
distribution             axes    point of the cube
=======================  ======  ===================================================================
float                    1       (v - low) / (high - low); of the logarithms with `log`
n values: float or int   1       the middle of the value's interval, 1/n of the axis
with a step
int with `log`           1       logarithm, from low - 1/2 to high + 1/2
n choices                n       3/4 for the choice and 1/4 for the others; the largest coordinate
                                 decides.  Two choices use one axis, like two values.
one value only           0
=======================  ======  ===================================================================

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
from typing import Any

import numpy as np
import numpy.typing as npt
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import SpaceError
from fide_plugins.types import Float64

__all__ = ["RelativeSpace", "Space"]

Distributions = Mapping[str, BaseDistribution]

_CHOSEN, _NOT_CHOSEN = 0.75, 0.25
_RECENT = 10  # trials
_MOST_SPACES = 8


def _by_name(name: str) -> tuple[tuple[str, int], ...]:
    """Key to sort names by: as text, but the whole numbers in them as numbers.

    >>> sorted(["x10", "x9", "a"], key=_by_name)
    ['a', 'x9', 'x10']
    """
    parts = re.split(r"([0-9]+)", name)  # text and numbers in turn
    return tuple((t, int(n or 0)) for t, n in zip(parts[::2], [*parts[1::2], ""], strict=True))


def _single_value(distribution: BaseDistribution) -> Any:
    """Value of a distribution that has only one."""
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices[0]
    if isinstance(distribution, FloatDistribution | IntDistribution):
        return distribution.low
    raise TypeError(f"not a distribution of Optuna: {distribution!r}")


class Space:
    """The unit cube of some distributions.

    distributions: by name.
    """

    def __init__(self, distributions: Distributions) -> None:
        self.distributions = {
            name: distributions[name] for name in sorted(distributions, key=_by_name)
        }
        varied = {n: d for n, d in self.distributions.items() if not d.single()}
        self._fixed = {n: _single_value(d) for n, d in self.distributions.items() if d.single()}
        self._scale = _Scale(
            {n: d for n, d in varied.items() if isinstance(d, FloatDistribution | IntDistribution)}
        )
        self._choices = {n: d for n, d in varied.items() if isinstance(d, CategoricalDistribution)}
        self._axes: dict[str, slice] = {}
        self.dim = 0
        for name, distribution in varied.items():
            width = 1
            if isinstance(distribution, CategoricalDistribution):
                width = len(distribution.choices) if len(distribution.choices) > 2 else 1
            self._axes[name] = slice(self.dim, self.dim + width)
            self.dim += width
        self._columns = np.array([self._axes[n].start for n in self._scale.names], np.intp)

    def decode(self, x: Float64) -> dict[str, Any]:
        """Parameters of a point x (dim,), as native numbers and choices."""
        params = dict(self._fixed)
        params.update(self._scale.values(x[self._columns]))
        for name, distribution in self._choices.items():
            params[name] = distribution.choices[_chosen(x[self._axes[name]])]
        return {name: params[name] for name in self.distributions}

    def encode(self, params: Mapping[str, Any]) -> Float64:
        """Point (dim,) of the parameters of a trial in this space."""
        x = np.empty(self.dim)
        values = np.array([params[name] for name in self._scale.names], np.float64)
        x[self._columns] = self._scale.points(values)
        for name, distribution in self._choices.items():
            axes = x[self._axes[name]]
            _choose(axes, int(distribution.to_internal_repr(params[name])))
        return x

    def snap(self, x: Float64) -> Float64:
        """Point (dim,) that encodes the parameters of a point x (dim,)."""
        snapped = x.copy()
        values = self._scale.rounded(x[self._columns])
        snapped[self._columns] = self._scale.points(values)
        for name in self._choices:
            axes = snapped[self._axes[name]]
            _choose(axes, _chosen(axes))
        return snapped

    def holds(self, trial: FrozenTrial) -> bool:
        """Whether the trial has all of these parameters, of these kinds and within these ranges."""
        params, kinds, own = trial.params, trial.distributions, self.distributions
        same_kinds = all(name in params and type(kinds[name]) is type(own[name]) for name in own)
        return same_kinds and self.contains(params)

    def contains(self, params: Mapping[str, Any]) -> bool:
        """Whether each of these parameters has a value, within its range."""
        return (
            all(name in params for name in self.distributions)
            and all(params[name] == value for name, value in self._fixed.items())
            and all(_is_choice(params[name], d) for name, d in self._choices.items())
            and self._scale.holds([params[name] for name in self._scale.names])
        )


def _is_choice(value: Any, distribution: CategoricalDistribution) -> bool:
    """Whether the value is one of the choices, as Optuna compares them: a NaN is a NaN."""
    try:
        distribution.to_internal_repr(value)
    except ValueError:
        return False
    return True


def _chosen(axes: Float64) -> int:
    """Choice that the coordinates of a categorical parameter encode."""
    return int(axes[0] >= 0.5) if len(axes) == 1 else int(np.argmax(axes))


def _choose(axes: Float64, choice: int) -> None:
    """Write the coordinates of a choice."""
    if len(axes) == 1:
        axes[0] = _CHOSEN if choice else _NOT_CHOSEN
    else:
        axes[:] = _NOT_CHOSEN
        axes[choice] = _CHOSEN


class _Scale:
    """All m numeric parameters at once; arrays are (m,)."""

    def __init__(self, numeric: Mapping[str, FloatDistribution | IntDistribution]) -> None:
        distributions = list(numeric.values())
        self.names = list(numeric)
        self._low = np.array([d.low for d in distributions], np.float64)
        self._high = np.array([d.high for d in distributions], np.float64)
        self._step = np.array([d.step or 0.0 for d in distributions], np.float64)
        self._log = np.array([d.log for d in distributions], bool)
        self._whole = {
            name: (d.low, d.high) for name, d in numeric.items() if isinstance(d, IntDistribution)
        }
        self._check_lengths()
        margin = self._step / 2  # 1/2 for each int, also with `log`
        self._bottom = self._scaled(self._low - margin)
        length = self._scaled(self._high + margin) - self._bottom
        self._length = np.where(length > 0, length, 1.0)  # 0: doubles cannot tell the ends apart

    def _check_lengths(self) -> None:
        """Raise SpaceError, as a `Float` does, for a range whose length no double holds."""
        with np.errstate(over="ignore"):
            endless = ~np.isfinite(self._high - self._low)
        for i in np.flatnonzero(endless)[:1]:
            raise SpaceError(
                f"parameter {self.names[i]!r}, from {self._low[i]} to {self._high[i]}: high - low "
                "must be finite; take a narrower range"
            )

    def _scaled(self, values: Float64) -> Float64:
        scaled = values.copy()
        scaled[self._log] = np.log(values[self._log])
        return scaled

    def points(self, values: Float64) -> Float64:
        return np.clip((self._scaled(values) - self._bottom) / self._length, 0.0, 1.0)

    def rounded(self, points: Float64) -> Float64:
        """Values of the distributions that are nearest to points in [0, 1]."""
        values = self._bottom + points * self._length
        values[self._log] = np.exp(values[self._log])
        stepped = self._step > 0
        low, step = self._low[stepped], self._step[stepped]
        values[stepped] = low + np.round((values[stepped] - low) / step) * step
        return np.clip(values, self._low, self._high)

    def values(self, points: Float64) -> dict[str, float | int]:
        """As `rounded`, by name, as native numbers."""
        found = dict(zip(self.names, self.rounded(points).tolist(), strict=True))
        for name, (low, high) in self._whole.items():  # beyond 2^53 doubles may miss both ends
            found[name] = min(max(int(found[name]), low), high)
        return found

    def holds(self, values: list[Any]) -> bool:
        try:
            array: npt.NDArray[np.float64] = np.array(values, np.float64)
        except (TypeError, ValueError):  # of an enqueued trial, which Optuna refuses
            return False
        return bool(((array >= self._low) & (array <= self._high)).all())


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
