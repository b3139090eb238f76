"""The optimizer of one search space of a study: it processes trials and names new candidates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from math import isclose, isfinite
from typing import Any, TypeAlias

from optuna.distributions import FloatDistribution
from optuna.trial import FrozenTrial
from torch import Tensor

from fide_adapters.optuna.search_space import SearchSpace
from fide_adapters.optuna.storage import MOST_NAMED, Ask, Trials
from fide_adapters.optuna.trials import History, News, TrialOrder
from fide_plugins.distributed.replica import Replica, Role
from fide_plugins.fide import FIDE

__all__ = ["Evaluation", "StoredFeaturesNeeded", "StudyOptimizer"]

_OWN = (Role.MEMBER, Role.ALTERED, Role.LATE)  # trials that were asked here
_ROUNDING = 1e-6  # relative, of a number that went through a database
_EARLIER = 10**6  # first slot of trials that were created before the generation, but ask only now

Evaluation: TypeAlias = tuple[float, Tensor | None]
"""Loss of a trial, and the features (T, C) of its image if they are known."""

Evaluate: TypeAlias = Callable[[FrozenTrial, bool], Evaluation | None]
"""Evaluation of a finished trial, None if it does not count.

The second argument says whether to use features only as they are stored.  If it is False and they
are known only as they are stored, StoredFeaturesNeeded is raised.
"""


class StoredFeaturesNeeded(Exception):
    """Features of an image are not in this process in full precision; no user sees this."""


class StudyOptimizer:
    """The replica of one search space, see `fide_plugins.distributed.replica`.

    space: of the parameters that it gives.
    make: makes its optimizer.
    history: what is known of the study's trials.
    digest: of search space and settings; workers with equal digests have the same optimizer.
    """

    def __init__(
        self, space: SearchSpace, make: Callable[[], FIDE], history: History, digest: str
    ) -> None:
        self.space, self.digest = space, digest
        self._numbers = [
            name
            for name, kind in space.distributions.items()
            if isinstance(kind, FloatDistribution) and kind.step is None and not kind.single()
        ]
        self._make, self._history = make, history
        self.only_stored = False
        """Whether it learns from features as they are stored, which are the same for all workers,
        and not from those that this process has computed."""
        self._broken = False  # by an exception in the midst of a trial
        self.restart()

    def restart(self) -> None:
        """Return to the state before the first trial."""
        self.replica = Replica(self._make(), self.space.snap)
        self._order = TrialOrder(self._history)
        self._first = 0  # number of the trial that gets slot 0
        self._begins = [(0, True)]  # when a search, or part of a restart, began; guided by images?
        self.counts: Counter[str] = Counter()
        """How many trials counted as what; see `FIDESampler.counts`."""
        self._without_image = 0  # trials of its own with a finite loss and no image

    @property
    def at(self) -> int:
        """All trials of lower numbers are processed or skipped."""
        return self._order.next

    def is_processed(self, number: int) -> bool:
        """Whether a trial has been processed; False for a skipped one that may still count."""
        return self._order.is_processed(number)

    def process(self, trials: Trials, evaluate: Evaluate) -> None:
        """Process the trials that have finished.

        After an exception, such as Ctrl-C, the next call begins anew: of a trial that was told in
        part nothing is known.
        """
        if self._broken:
            self.restart()
        self._broken = True
        try:
            self._process(trials, evaluate)
        except StoredFeaturesNeeded:
            self.only_stored = True
            self.restart()
            self._process(trials, evaluate)
        self._broken = False

    def _process(self, trials: Trials, evaluate: Evaluate) -> None:
        for trial in self._order.processable(trials):
            evaluation = evaluate(trial, self.only_stored) if self.space.holds(trial) else None
            if evaluation is None:
                self.counts["left out"] += 1
            else:
                self._tell(trial, *evaluation)

    def _tell(self, trial: FrozenTrial, loss: float, tokens: Tensor | None) -> None:
        ask = self._history.ask_of(trial)
        name: dict[str, Any] = {}
        if ask is not None and ask.optimizer == self.digest:
            name = {"generation": ask.generation, "slot": ask.slot, "proposed": ask.proposed}
            self._log_other_seed(trial, ask)
        generation = self.replica.generation
        began = self._history.began(self.digest, generation + 1)
        over, guided = (None, None) if began is None else (began[0] == generation + 1, began[1])
        x = self.space.encode(trial.params)
        if trial.number == 0 and self.replica.is_candidate(0, x):  # see `StudyState.first`
            name = {"generation": 0, "slot": 0}
        role = self.replica.tell(x, loss, tokens, over=over, guided=guided, **name)
        self.counts[role.value] += 1
        self.counts["image"] += tokens is not None
        self._without_image += role in _OWN and tokens is None and isfinite(loss)
        if self.replica.generation != generation:
            self._first = max(self._order.next, trial.number + 1)
            if self.replica.began != self._begins[-1][0]:
                self._begins.append((self.replica.began, self.replica.guided))

    def _log_other_seed(self, trial: FrozenTrial, ask: Ask) -> None:
        """Log that a trial has none of the numbers of the candidate whose name it has.

        Only the seed says what the candidates of the first generation are.
        """
        first = self.replica.generation == 0 == ask.generation and ask.slot < self.replica.size
        if not first or not self._numbers:
            return
        own, kinds = self.space.decode(self.replica.candidate(ask.slot).x), self.space.distributions
        names = [n for n in self._numbers if trial.distributions[n] == kinds[n]]  # others are drawn
        if names and not any(isclose(own[n], trial.params[n], rel_tol=_ROUNDING) for n in names):
            self._history.warnings.log(
                "seed",
                f"trial {trial.number} was asked with another seed than this worker has, so what "
                "one asks counts as altered for the other; give all workers of a study the same "
                "seed, or none",
            )

    @property
    def lacks_images(self) -> bool:
        """Whether as many of its own as a generation has have a loss, and none has an image.

        What has no finite loss failed, so that there may be no image.
        """
        return self._without_image >= self.replica.size and not self.counts["image"]

    def agrees(self, news: News) -> bool:
        """Whether the trials processed so far are consistent with what is new."""
        if any(number < self.at for number in news.skipped):
            return False  # it was processed in its place, but counts later
        return all(
            tuple(began) == max(begin for begin in self._begins if begin[0] <= generation)
            for optimizer, generation, *began in news.began
            if optimizer == self.digest and generation <= self.replica.generation
        )

    def skip_overdue(self, trials: Trials, number: int, evaluate: Evaluate) -> list[int]:
        """Skip trials before `number` that take too long, and process what follows them.

        Returns the numbers of the skipped trials.
        """
        skipped: list[int] = []
        while len(skipped) < MOST_NAMED:
            overdue = self._order.overdue(trials, self.replica.size)
            overdue = [n for n in overdue if n < number][: MOST_NAMED - len(skipped)]
            if not overdue:
                break
            skipped += overdue
            self._history.skip(overdue)
            self._history.warn_of_dead(trials, self.replica.size)
            self.process(trials, evaluate)
        return skipped

    def ask(
        self, trials: Trials, number: int, skipped: list[int], late: list[int]
    ) -> tuple[Ask, dict[str, Any]]:
        """Record and parameters of trial `number`."""
        slot = number - self._first if number >= self._first else _EARLIER + number
        candidate = self.replica.newest(slot, self._order.pending(trials, number))
        ask = Ask(
            self.digest,
            self.replica.generation,
            slot,
            self.replica.began,
            candidate.proposed,
            tuple(skipped),
            tuple(late[:MOST_NAMED]),
            self.replica.guided,
        )
        return ask, self.space.decode(candidate.x)

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "replica": self.replica.state_dict()}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)
        self.replica = Replica.from_state(self._make(), state["replica"], self.space.snap)
