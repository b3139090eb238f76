"""In which order all workers process a study's trials, without communicating, and with which loss.

The order is that of the trials' numbers, which the storage assigns once each.  A finished trial
never changes, so all workers that have processed the trials below some number have processed the
same.  What remains is a trial that does not finish, because a worker was killed, or because a user
forgot to call `study.tell`:

- *Waiting*: processing stops at the first unfinished trial.  New trials get candidates of the
  current generation.
- *Skipping*: when enough later trials have completed, the next worker that asks stops waiting, and
  its own record says so; from then on all workers skip the trial.  Enough are as many as a
  generation has, and four times as many as were completed while any of them ran.
- *Late*: a skipped trial that completes after all counts at the place of the first trial that is
  asked then, as the record of that one says.

A worker that has processed a trial in its place, and then reads that the trial was skipped,
processes all trials again.  Nothing is rendered for that.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice, takewhile
from numbers import Real

from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import ASK, MOST_NAMED, Ask, Trials, WarnOnce, read_ask

_PATIENCE = 4  # how much longer a trial may take than the slowest of the later ones
CONSTRAINTS = "constraints"  # Optuna's attribute: a list until Optuna 4, then one for each
_INFEASIBLE = 1e100  # above any meaningful loss
_WORST_VIOLATION = 1e100  # larger ones all count as this


# -- what the storage says -------------------------------------------------------------------------


@dataclass
class News:
    """Trials that have finished since, numbers of those skipped since, and beginnings of searches.

    began: (optimizer, generation, generation in which its search began, whether guided there).
    """

    finished: list[FrozenTrial] = field(default_factory=list)
    skipped: set[int] = field(default_factory=set)
    began: list[tuple[str, int, int, bool]] = field(default_factory=list)


class History:
    """Facts about a study's trials that all workers can read in the storage.

    No trial is looked at again once it has finished and its record was read.
    """

    def __init__(self, warn: WarnOnce) -> None:
        self._warn = warn
        self.skipped: set[int] = set()
        """Trials that are no longer waited for."""
        self._seen = 0  # number of trials looked at
        self._unread: set[int] = set()  # of these, the ones whose record may still come
        self._unfinished: set[int] = set()
        self._uncounted: set[int] = set()  # skipped trials that count nowhere yet
        self._late_at: dict[int, list[int]] = {}  # skipped trials that count at this one
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
        ask, number = read_ask(trial), trial.number
        if ask is not None or trial.state.is_finished():
            self._unread.discard(number)
        if ask is None:
            if trial.system_attrs.get(ASK) is not None:
                self._warn(
                    ASK,
                    f"the attribute {ASK!r} of trial {number} was not written by FIDESampler of "
                    "this version, and is ignored",
                )
            return
        news.skipped.update(self.skip(ask.skipped))
        if ask.late and number not in self.skipped:
            self._late_at[number] = list(ask.late)
            self._uncounted.difference_update(ask.late)
        key = ask.optimizer, ask.generation
        known = self._began.get(key)
        if known is None or number < known[0]:  # where they disagree, the lowest number is valid
            self._began[key] = number, ask.began, ask.guided
            news.began.append((*key, ask.began, ask.guided))

    def began(self, optimizer: str, generation: int) -> tuple[int, bool] | None:
        """When the search of `generation` began, and whether guided; None if no record says it."""
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

    def uncounted(self, trials: Trials) -> list[int]:
        """Skipped trials that have completed and count nowhere yet."""
        done = {n for n in self._uncounted if trials[n].state.is_finished()}
        self._uncounted -= {n for n in done if trials[n].state is not TrialState.COMPLETE}
        return sorted(self._uncounted & done)


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
                late = self._late_at(read_ask(trial))
                if not all(t.state.is_finished() for t in (trial, *(trials[n] for n in late))):
                    return
                self._counted_late.update(late)
                for number in late:
                    yield trials[number]
                yield trial
            self.next += 1

    def _late_at(self, ask: Ask | None) -> list[int]:
        uncounted = self._history.skipped - self._counted_late
        return [] if ask is None else [number for number in ask.late if number in uncounted]

    def is_processed(self, number: int) -> bool:
        """Whether a trial has been processed; False for a skipped one that may still count."""
        skipped = number in self._history.skipped and number not in self._counted_late
        return number < self.next and not skipped

    def _ahead(self, trials: Trials) -> list[FrozenTrial]:
        return [t for t in trials[self.next :] if t.number not in self._history.skipped]

    def pending(self, trials: Trials, number: int) -> int:
        """How many trials before `number` are still to be processed, as far as is known."""
        countable = (TrialState.RUNNING, TrialState.COMPLETE)
        return sum(t.state in countable for t in self._ahead(trials[:number]))

    def overdue(self, trials: Trials, generation: int) -> list[int]:
        """Unfinished trials, next in the order, not worth waiting for; generation: its size."""
        ahead = self._ahead(trials)
        completed = [trial for trial in ahead if trial.state is TrialState.COMPLETE]
        if len(completed) < generation or ahead[0].state.is_finished():
            return []
        if len(completed) < _PATIENCE * _most_at_once(completed):
            return []
        unfinished = takewhile(lambda trial: not trial.state.is_finished(), ahead)
        return [trial.number for trial in islice(unfinished, MOST_NAMED)]


def _most_at_once(completed: list[FrozenTrial]) -> int:
    """How many of these trials were completed while one of them ran, itself included, at most."""
    times = [
        (trial.datetime_start.replace(tzinfo=None), trial.datetime_complete.replace(tzinfo=None))
        for trial in completed
        if trial.datetime_start and trial.datetime_complete
    ]
    ends = sorted(end for _, end in times)
    during = (bisect_right(ends, end) - bisect_left(ends, start) for start, end in times)
    return max(during, default=1)


# -- the loss --------------------------------------------------------------------------------------


def loss_of(study: Study, trial: FrozenTrial, warn: WarnOnce) -> float | None:
    """Loss of a finished trial, the lower the better; None if the trial does not count.

    A trial that violates constraints ranks behind all that do not, and before those that violate
    them more (Deb 2000, "An efficient constraint handling method for genetic algorithms", sec. 3).
    """
    if trial.state is not TrialState.COMPLETE or trial.value is None:
        return None
    attributes, prefix = trial.system_attrs, f"{CONSTRAINTS}:"
    legacy = attributes.get(CONSTRAINTS, [])
    stored = list(legacy) if isinstance(legacy, list | tuple) else [legacy]
    stored += [value for key, value in attributes.items() if key.startswith(prefix)]
    violation = 0.0
    for value in stored:  # <= 0 where nothing is violated
        if isinstance(value, Real) and not isinstance(value, bool):
            try:
                above = float(value)
            except OverflowError:  # a whole number beyond all floats
                above = 0.0 if str(value).startswith("-") else _WORST_VIOLATION
            violation += max(min(above, _WORST_VIOLATION), 0.0) if above == above else math.inf
        else:
            warn(
                CONSTRAINTS, f"a constraint of trial {trial.number} is not a number, and is ignored"
            )
    if violation > 0:
        return _INFEASIBLE * (1.0 + min(violation, _WORST_VIOLATION))
    return -trial.value if study.direction is StudyDirection.MAXIMIZE else trial.value
