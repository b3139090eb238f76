"""When a fit is over.

Budget, time and the other rules are no settings: a fit that was stopped by one of them goes on with
``resume=True`` and a larger number.

================  =================================================================================
`budget`          evaluations, those before resuming included; failed renders do not count
`time`            seconds of fitting, those before resuming included
`stop_at`         the best loss is at most this
`until_stalled`   nothing more is to be expected (see `_is_stalled`)
================  =================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fitting.durations import seconds_of
from fide_plugins.validation.option_rules import switch
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["Stopping"]

_OVER = ("solved", "noise", "agreed")
_PATIENCE = 150  # generations: a dozen moves or so


@dataclass(frozen=True, slots=True)
class Stopping:
    """Rules by which a fit stops; None: not by this one."""

    budget: int | None
    seconds: float | None = None
    stop_at: float | None = None
    until_stalled: bool = False

    @classmethod
    def of(cls, budget: object, time: object, stop_at: Any, until_stalled: bool) -> Stopping:
        """Rules as a user gives them; raises OptionError (a ValueError)."""
        number = None if budget is None else whole_number("budget", budget, 1)
        seconds = None if time is None else seconds_of("time", time)
        if not switch("until_stalled", until_stalled) and number is None and seconds is None:
            raise OptionError(
                "budget=None needs another rule by which the fit ends: give time or until_stalled"
            )
        return cls(number, seconds, _loss(stop_at), until_stalled)

    def reached(
        self, evaluations: int, seconds: float, best: float, improved: bool, optimizer: FIDE
    ) -> str | None:
        """Name of the rule that says that it is over; None: none of them.

        improved: whether the last evaluation was the best so far.
        """
        if self.budget is not None and evaluations >= self.budget:
            return "budget"
        if self.seconds is not None and seconds >= self.seconds:
            return "time"
        if self.stop_at is not None and best <= self.stop_at:
            return "stop_at"
        if self.until_stalled and (improved or evaluations % optimizer.popsize == 0):
            return "until_stalled" if _is_stalled(optimizer) else None
        return None

    def record(self) -> dict[str, Any]:
        """The rules, for a file."""
        rules = {
            "budget": self.budget,
            "time": self.seconds,
            "stop_at": self.stop_at,
            "until_stalled": self.until_stalled or None,
        }
        return {name: value for name, value in rules.items() if value is not None}


def _is_stalled(optimizer: FIDE) -> bool:
    """Whether nothing more is to be expected.

    Solved, at the noise floor, or several searches ended at the same answer: at once.  Otherwise if
    the loss has not improved by a tenth for 150 generations and for as many evaluations as it took
    to get there: stalls are overcome by moves, each of which takes some ten generations and mostly
    fails.
    """
    status = optimizer.status
    if status.code in ("waiting", "improving"):
        return False
    state = optimizer.state
    since, took = state.evaluations - state.improved_at, state.improved_at - state.retargeted_at
    return status.code in _OVER or since >= max(took, _PATIENCE * optimizer.popsize)


def _loss(stop_at: Any) -> float | None:
    if stop_at is None:
        return None
    try:
        loss = np.nan if isinstance(stop_at, bool | str) else float(stop_at)
    except (TypeError, ValueError, OverflowError):
        loss = np.nan
    if not np.isfinite(loss):
        raise OptionError(f"stop_at must be a finite number, a loss, not {stop_at!r}")
    return loss
