"""What a trial's result is worth to a minimizer."""

from __future__ import annotations

import math
from numbers import Real

from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna_parts.voice import Voice

__all__ = ["loss_of"]

_KEY = "constraints"  # of Optuna's attributes: a list until Optuna 4, then one for each
_INFEASIBLE = 1e100  # above any loss that anybody means
_WORST = 1e100  # violation; beyond it all are alike


def loss_of(study: Study, trial: FrozenTrial, consider_pruned: bool, voice: Voice) -> float | None:
    """Loss of a finished trial, the lower the better, or None if it says nothing.

    A trial that violates constraints ranks behind all that do not, and before those that violate
    them more (Deb 2000, "An efficient constraint handling method for genetic algorithms", sec. 3).
    """
    value = _value(trial, consider_pruned)
    if value is None:
        return None
    violation = sum(_violation(stored, trial.number, voice) for stored in _constraints(trial))
    if violation > 0:
        return _INFEASIBLE * (1.0 + min(violation, _WORST))
    return -value if study.direction is StudyDirection.MAXIMIZE else value


def _value(trial: FrozenTrial, consider_pruned: bool) -> float | None:
    if trial.state is TrialState.COMPLETE:
        return trial.value
    if trial.state is TrialState.PRUNED and consider_pruned and trial.intermediate_values:
        return trial.intermediate_values[max(trial.intermediate_values)]
    return None


def _constraints(trial: FrozenTrial) -> list[object]:
    """What is stored as constraints; numbers that must not be above zero, if all is well."""
    earlier = trial.system_attrs.get(_KEY, [])
    known = list(earlier) if isinstance(earlier, list | tuple) else [earlier]
    return known + [c for key, c in trial.system_attrs.items() if key.startswith(f"{_KEY}:")]


def _violation(stored: object, number: int, voice: Voice) -> float:
    """By how much one constraint is violated; 0 for what is no number."""
    if not isinstance(stored, Real) or isinstance(stored, bool):
        voice.warn(_KEY, f"a constraint of trial {number} is no number, and is ignored")
        return 0.0
    try:
        value = float(stored)
    except OverflowError:  # of a whole number
        value = -math.inf if isinstance(stored, int) and stored < 0 else math.inf
    return max(value, 0.0) if value < _WORST else _WORST  # where NaN is, too
