"""When a fit is over; it goes on with ``resume=True`` and a larger number.

`until`: "solved", or only noise of the target is left; "stalled": or no progress; "budget".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.validation.options import seconds_of
from fide_plugins.validation.points import as_real, whole_number
from fide_plugins.views.findings import is_solved

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.schedule import Schedule

UNTIL = ("solved", "stalled", "budget")
_LAST = 1000  # candidates
_PATIENCE = 150  # generations: a dozen moves or so


@dataclass(frozen=True, slots=True)
class Stopping:
    """Rules by which a fit stops; None: not by this one."""

    budget: int | None
    seconds: float | None = None
    stop_at: float | None = None
    until: str = "solved"
    schedule: Schedule | None = None  # rules about an answer hold for its finest renders only

    @classmethod
    def of(
        cls, budget: object, time: object, stop_at: object, until: object = "solved"
    ) -> Stopping:
        """Rules as a user gives them; raises OptionError (a ValueError)."""
        number = None if budget is None else whole_number("budget", budget, 1)
        seconds = None if time is None else seconds_of("time", time)
        if until not in UNTIL:
            raise OptionError(f"until must be {', '.join(map(repr, UNTIL))}, not {until!r}")
        if until != "stalled" and number is None and seconds is None:
            raise OptionError(
                "budget=None needs another rule by which the fit ends for sure: give time or "
                "until='stalled'"
            )
        loss = None if stop_at is None else as_real(stop_at)
        if stop_at is not None and (loss is None or not np.isfinite(loss)):
            raise OptionError(f"stop_at must be a finite number, a loss, not {stop_at!r}")
        return cls(number, seconds, loss, str(until))

    def reached(
        self, losses: Sequence[float], seconds: float, best: float, improved: bool, optimizer: FIDE
    ) -> str | None:
        """Name of the rule that says that it is over; None: none of them.

        losses: of all evaluations; improved: whether the last one was the best so far.
        `until` is looked at after each improvement, and after each generation.
        """
        found = self._reached(losses, seconds, best, improved, optimizer)
        schedule = self.schedule
        if schedule is None or found in (None, "budget", "time") or schedule.is_finest:
            return found
        schedule.step_up(larger=True)
        return None

    def _reached(
        self, losses: Sequence[float], seconds: float, best: float, improved: bool, optimizer: FIDE
    ) -> str | None:
        if self.budget is not None and len(losses) >= self.budget:
            return "budget"
        if self.seconds is not None and seconds >= self.seconds:
            return "time"
        if self.stop_at is not None and best <= self.stop_at:
            return "stop_at"
        if self.until == "budget" or not (improved or len(losses) % optimizer.popsize == 0):
            return None
        state = optimizer.state
        image = None if state.best is None else state.best.solution.image
        if image is not None and is_solved(optimizer.views, image):
            return "solved"
        if len(losses) % optimizer.popsize:
            return None
        # to look for noise takes time, so it is not done while the loss still falls
        converged = _is_converged(losses, best, optimizer)
        last = None if state.best is None else state.best.solution.evaluation
        fallen = last is not None and state.evaluations - last <= optimizer.popsize
        if not converged and (self.until == "solved" or fallen):
            return None
        code = optimizer.status.code
        if converged and code == "noise":
            return code
        return "stalled" if self.until == "stalled" and _is_stalled(code, optimizer) else None

    def spent(self, evaluations: int, seconds: float) -> tuple[float, float]:
        """Share of budget or time that is spent, the larger; and renders left of the budget."""
        left = np.inf if self.budget is None else self.budget - evaluations
        shares = (
            0.0 if self.budget is None else evaluations / self.budget,
            0.0 if self.seconds is None else seconds / self.seconds,
        )
        return max(shares), left

    def record(self) -> dict[str, Any]:
        """The rules, for a file."""
        found = {"budget": self.budget, "time": self.seconds, "stop_at": self.stop_at}
        return {k: v for k, v in found.items() if v is not None} | {"until": self.until}


def _is_converged(losses: Sequence[float], best: float, optimizer: FIDE) -> bool:
    """Whether the search knows the answer as well as noise of the target allows."""
    within = best + abs(best) * optimizer.dim / optimizer.views.numbers
    last = np.asarray(losses[-max(_LAST, optimizer.popsize) :])
    return int(np.count_nonzero(last <= within)) >= optimizer.popsize


def _is_stalled(code: str, optimizer: FIDE) -> bool:
    """Whether nothing more is to be expected."""
    if code in ("waiting", "improving"):
        return False
    state = optimizer.state
    if code == "agreed" or (code == "noise" and state.pixel_noise.variance):
        return True
    since, took = state.evaluations - state.improved_at, state.improved_at - state.retargeted_at
    return since >= max(took, _PATIENCE * optimizer.popsize)
