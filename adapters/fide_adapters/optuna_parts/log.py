"""In which order all workers tell their optimizers the same trials, without talking to each other.

The order is that of the trials' numbers, which a storage gives out once each.  A finished trial
never changes, so whoever has told all trials below some number has told what everybody has told, or
will.  What remains is the trial that does not finish: a worker was killed, a user forgot to tell.

- *Waiting*: the log stops at the first unfinished trial; meanwhile later ones are asked, of the
  present generation.
- *Passing*: when enough later trials have completed (as many as a generation has, and four times as
  many as are running), whoever asks next stops waiting, and says so in its own record.  From then
  on the trial is passed for everybody.
- *Late*: a passed trial that completes after all counts where the first trial that is asked then
  has its place.  That trial's record says so, which all can read before they get there.

Whether a trial is slow enough to be passed is seen at different moments by different workers, so
somebody may have told it in its place when a record appears that passed it.  It then tells
everything anew; nothing is rendered for that.
"""

from __future__ import annotations

from collections.abc import Iterator

from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna_parts.history import History, Trials
from fide_adapters.optuna_parts.records import MOST_NAMED

__all__ = ["Log"]

_TO_BE_TOLD = (TrialState.RUNNING, TrialState.COMPLETE)
_PATIENCE = 4  # trials that complete meanwhile, for each that is running


class Log:
    """The place that one optimizer has reached in the order of trials."""

    def __init__(self, history: History) -> None:
        self._history = history
        self.next = 0
        """Trials of lower numbers were told, or never will be, or are late."""
        self._counted_late: set[int] = set()

    def ready(self, trials: Trials) -> Iterator[FrozenTrial]:
        """Trials that are to be told next, up to the first that is waited for."""
        while self.next < len(trials):
            trial = trials[self.next]
            if self.next not in self._history.passed:
                late = self._late_at(trial)
                if not all(t.state.is_finished() for t in (trial, *(trials[n] for n in late))):
                    return
                self._counted_late.update(late)
                for number in late:
                    yield trials[number]
                yield trial
            self.next += 1

    def is_over(self, number: int) -> bool:
        """Whether a trial was told, or never will be."""
        passed = number in self._history.passed and number not in self._counted_late
        return number < self.next and not passed

    def _late_at(self, trial: FrozenTrial) -> list[int]:
        ask = self._history.ask_of(trial)
        named = () if ask is None else ask.late
        return [n for n in named if n in self._history.passed and n not in self._counted_late]

    def out(self, trials: Trials, number: int) -> int:
        """Trials before `number` that are still to be told, as far as one can know."""
        ahead = (trials[n] for n in range(self.next, number) if n not in self._history.passed)
        return sum(trial.state in _TO_BE_TOLD for trial in ahead)

    def overdue(self, trials: Trials, generation: int) -> list[int]:
        """Unfinished trials, the first of the log, that are no longer to be waited for.

        generation: how many trials one has.
        """
        ahead = [trials[n] for n in range(self.next, len(trials)) if n not in self._history.passed]
        running = sum(trial.state is TrialState.RUNNING for trial in ahead)
        completed = sum(trial.state is TrialState.COMPLETE for trial in ahead)
        overdue: list[int] = []
        for trial in ahead:
            if trial.state.is_finished() or len(overdue) == MOST_NAMED:
                break
            if completed < max(generation, _PATIENCE * running):
                break
            overdue.append(trial.number)
        return overdue
