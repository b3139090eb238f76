"""In which order all workers process a study's trials, without communicating, and with which loss.

The order is that of the trials' numbers, which the storage assigns once each.  A finished trial
never changes, so all workers that have processed the trials below some number have processed the
same.  What remains is a trial that does not finish, because a worker was killed, or because a user
forgot to call `study.tell`:

- *Waiting*: processing stops at the first unfinished trial.  New trials continue to get candidates
  of the current generation.
- *Skipping*: when enough later trials have completed, the next worker that asks stops waiting, and
  its own record says so.  From then on all workers skip the trial.  Enough are as many as a
  generation has, and four times as many as were completed while any of the latest trials ran: of
  100 workers about 4 x 100, however many trials of killed workers are never told.
- *Late*: a skipped trial that completes after all counts at the place of the first trial that is
  asked then.  The record of that trial says so, and all workers read the record before they get
  there.

Workers may disagree for a moment on which trial is slow enough to be skipped.  A worker that has
processed a trial in its place, and then reads that the trial was skipped, processes all trials
again.  Nothing is rendered for that.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from itertools import islice, takewhile
from numbers import Real

from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import ASK, MOST_NAMED, Ask, Trials, WarnOnce, read_ask

__all__ = ["CONSTRAINTS", "History", "News", "TrialOrder", "loss_of"]

_COUNTABLE = (TrialState.RUNNING, TrialState.COMPLETE)
_PATIENCE = 4  # how much longer a trial may take than the slowest of the latest ones
_LATEST = 4  # generations
CONSTRAINTS = "constraints"  # Optuna's attribute: a list until Optuna 4, then one for each
_INFEASIBLE = 1e100  # above any meaningful loss
_WORST_VIOLATION = 1e100  # larger ones all count as this


# -- what the storage says -------------------------------------------------------------------------


@dataclass
class News:
    """What an update of the history found.

    finished: trials that have finished since.
    skipped: numbers of trials that are skipped since.
    began: (optimizer, generation, generation in which its search began, whether guided there),
        each read for the first time.
    """

    finished: list[FrozenTrial] = field(default_factory=list)
    skipped: set[int] = field(default_factory=set)
    began: list[tuple[str, int, int, bool]] = field(default_factory=list)


class History:
    """Facts about a study's trials that all workers can read in the storage.

    A study may have thousands of trials and is read before each: no trial is looked at again once
    it has finished and its record was read.

    warnings: where it is reported what is wrong with trials.
    problem: digest of target and loss, see `Ask`; None without a target.
    """

    def __init__(self, warnings: WarnOnce, problem: str | None) -> None:
        self.warnings, self._problem = warnings, problem
        self.skipped: set[int] = set()
        """Trials that are no longer waited for."""
        self._seen = 0  # number of trials looked at
        self._unread: set[int] = set()  # of these, the ones whose record may still come
        self._unfinished: set[int] = set()
        self._uncounted: set[int] = set()  # skipped trials that count nowhere yet
        self._late_at: dict[int, tuple[int, ...]] = {}  # skipped trials that count at this one
        self._began: dict[tuple[str, int], tuple[int, int, bool]] = {}  # by trial; see `began`

    def update(self, trials: Trials) -> News:
        """Look at what is new."""
        new = range(self._seen, len(trials))
        self._seen = len(trials)
        self._unread.update(new)
        self._unfinished.update(new)
        news = News()
        for number in sorted(self._unread):
            self._read(trials[number], news)
        finished = [n for n in sorted(self._unfinished) if trials[n].state.is_finished()]
        self._unfinished.difference_update(finished)
        news.finished += [trials[n] for n in finished]
        return news

    def _read(self, trial: FrozenTrial, news: News) -> None:
        ask = self.ask_of(trial)
        if ask is not None or trial.state.is_finished():
            self._unread.discard(trial.number)
        if ask is not None:
            news.skipped.update(self.skip(ask.skipped))
            self._note_late(trial.number, ask)
            self._note_began(trial.number, ask, news)

    def ask_of(self, trial: FrozenTrial) -> Ask | None:
        """Record of a trial; None if there is no valid one."""
        record = trial.system_attrs.get(ASK)
        if record is None:
            return None
        ask = read_ask(record)
        if ask is None:
            self.warnings.warn(
                ASK,
                f"the attribute {ASK!r} of trial {trial.number} was not written by FIDESampler, "
                "and is ignored",
            )
            return None
        return ask.read_for(self._problem).about_trials_before(trial.number)

    def _note_late(self, number: int, ask: Ask) -> None:
        if ask.late and number not in self.skipped:
            self._late_at[number] = ask.late
            self._uncounted.difference_update(ask.late)

    def _note_began(self, number: int, ask: Ask, news: News) -> None:
        """Where records disagree, that of the lowest trial number is valid."""
        key = ask.optimizer, ask.generation
        known = self._began.get(key)
        if known is None or number < known[0]:
            self._began[key] = number, ask.began, ask.guided
            news.began.append((*key, ask.began, ask.guided))

    def began(self, optimizer: str, generation: int) -> tuple[int, bool] | None:
        """Generation in which the search of `generation` began, and whether guided there.

        None if no record says it.
        """
        known = self._began.get((optimizer, generation))
        return None if known is None else known[1:]

    def skip(self, numbers: Iterable[int]) -> set[int]:
        """Stop waiting for trials; returns those that were not skipped before."""
        skipped = set(numbers) - self.skipped
        self.skipped |= skipped
        self._uncounted |= skipped
        for number in skipped:  # a trial that is skipped itself can be no place for late ones
            self._uncounted.update(self._late_at.pop(number, ()))
        return skipped

    def warn_of_dead(self, trials: Trials, many: int) -> None:
        """Warn once if so many skipped trials still run; one or two may just be slow."""
        dead = sorted(n for n in self._uncounted if trials[n].state is TrialState.RUNNING)
        if len(dead) >= many:
            self.warnings.warn(
                "dead",
                f"{len(dead)} trials that began long ago still run, trial {dead[0]} first. The "
                "sampler waited for each of them before it learned from later ones. If they are "
                f"dead, say so: study.tell({dead[0]}, state=TrialState.FAIL)",
            )

    def uncounted(self, trials: Trials) -> list[int]:
        """Skipped trials that have completed and count nowhere yet."""
        done = [n for n in self._uncounted if trials[n].state.is_finished()]
        failed = [n for n in done if trials[n].state is not TrialState.COMPLETE]
        self._uncounted.difference_update(failed)
        return sorted(self._uncounted.intersection(done))


# -- the order -------------------------------------------------------------------------------------


class TrialOrder:
    """The place that one optimizer has reached in the order of trials."""

    def __init__(self, history: History) -> None:
        self._history = history
        self.next = 0
        """All trials of lower numbers are processed or skipped."""
        self._counted_late: set[int] = set()

    def processable(self, trials: Trials) -> Iterator[FrozenTrial]:
        """Trials to process next, up to the first that is waited for."""
        while self.next < len(trials):
            trial = trials[self.next]
            if self.next not in self._history.skipped:
                late = self._late_at(trial)
                if not all(t.state.is_finished() for t in (trial, *(trials[n] for n in late))):
                    return
                self._counted_late.update(late)
                for number in late:
                    yield trials[number]
                yield trial
            self.next += 1

    def is_processed(self, number: int) -> bool:
        """Whether a trial has been processed; False for a skipped one that may still count."""
        skipped = number in self._history.skipped and number not in self._counted_late
        return number < self.next and not skipped

    def _late_at(self, trial: FrozenTrial) -> list[int]:
        ask = self._history.ask_of(trial)
        named = () if ask is None else ask.late
        return [n for n in named if n in self._history.skipped and n not in self._counted_late]

    def pending(self, trials: Trials, number: int) -> int:
        """How many trials before `number` are still to be processed, as far as is known."""
        ahead = (trials[n] for n in range(self.next, number) if n not in self._history.skipped)
        return sum(trial.state in _COUNTABLE for trial in ahead)

    def overdue(self, trials: Trials, generation: int) -> list[int]:
        """Unfinished trials, the next in the order, that are not worth waiting for any longer.

        generation: candidates a generation.
        """
        ahead = [trials[n] for n in range(self.next, len(trials)) if n not in self._history.skipped]
        completed = sum(trial.state is TrialState.COMPLETE for trial in ahead)
        if completed < generation or ahead[0].state.is_finished():
            return []
        # Also those that were completed while the first of these ran, or slow ones would be missed.
        latest = _LATEST * generation
        recent = trials[max(0, self.next - len(ahead) - latest) :]
        running = sum(trial.state is TrialState.RUNNING for trial in ahead)
        at_once = min(running, _most_at_once(recent, latest))
        if completed < max(generation, _PATIENCE * at_once):
            return []
        unfinished = takewhile(lambda trial: not trial.state.is_finished(), ahead)
        return [trial.number for trial in islice(unfinished, MOST_NAMED)]


def _most_at_once(trials: Trials, latest: int) -> int:
    """How many trials were completed while one ran, itself included: the most of the latest ones.

    trials: among them those that were completed while the latest ran.
    latest: number of completed trials, by the time of their ends.

    Only the times of completed trials say how many workers are alive: trials of those that were
    killed run forever.  Where times are whole seconds, all that end in the same one count.
    """
    times = sorted(
        (_naive(trial.datetime_complete), _naive(trial.datetime_start))
        for trial in trials
        if trial.state is TrialState.COMPLETE and trial.datetime_complete and trial.datetime_start
    )
    ends = [end for end, _ in times]
    during = (bisect_right(ends, end) - bisect_left(ends, start) for end, start in times[-latest:])
    return max(during, default=1)


def _naive(time: datetime) -> datetime:
    """Local time; only somebody who adds trials can give them another zone."""
    return time.replace(tzinfo=None)


# -- the loss --------------------------------------------------------------------------------------


def loss_of(
    study: Study, trial: FrozenTrial, consider_pruned: bool, warnings: WarnOnce
) -> float | None:
    """Loss of a finished trial, the lower the better; None if the trial does not count.

    A trial that violates constraints ranks behind all that do not, and before those that violate
    them more (Deb 2000, "An efficient constraint handling method for genetic algorithms", sec. 3).
    """
    value = _value(trial, consider_pruned)
    if value is None:
        return None
    violation = sum(_violation(stored, trial.number, warnings) for stored in _constraints(trial))
    if violation > 0:
        return _INFEASIBLE * (1.0 + min(violation, _WORST_VIOLATION))
    return -value if study.direction is StudyDirection.MAXIMIZE else value


def _value(trial: FrozenTrial, consider_pruned: bool) -> float | None:
    if trial.state is TrialState.COMPLETE:
        return trial.value
    if trial.state is TrialState.PRUNED and consider_pruned and trial.intermediate_values:
        return trial.intermediate_values[max(trial.intermediate_values)]
    return None


def _constraints(trial: FrozenTrial) -> list[object]:
    """What is stored as constraints: numbers that must not be positive, if all is well."""
    legacy = trial.system_attrs.get(CONSTRAINTS, [])
    known = list(legacy) if isinstance(legacy, list | tuple) else [legacy]
    prefix = f"{CONSTRAINTS}:"
    return known + [value for key, value in trial.system_attrs.items() if key.startswith(prefix)]


def _violation(stored: object, number: int, warnings: WarnOnce) -> float:
    """By how much one constraint is violated; 0 if it is not a number."""
    if not isinstance(stored, Real) or isinstance(stored, bool):
        warnings.warn(
            CONSTRAINTS, f"a constraint of trial {number} is not a number, and is ignored"
        )
        return 0.0
    try:
        value = float(stored)
    except OverflowError:  # a whole number beyond all floats
        value = -math.inf if isinstance(stored, int) and stored < 0 else math.inf
    return max(value, 0.0) if value < _WORST_VIOLATION else _WORST_VIOLATION  # also of NaN
