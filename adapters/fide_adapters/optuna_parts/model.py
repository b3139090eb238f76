"""One optimizer of a study: it reads the log of trials, and names the candidate of a trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from optuna.trial import FrozenTrial
from torch import Tensor

from fide_adapters.optuna_parts.history import History, News, Trials
from fide_adapters.optuna_parts.log import Log
from fide_adapters.optuna_parts.records import MOST_NAMED, Ask
from fide_adapters.optuna_parts.space import Space
from fide_plugins.fide import FIDE
from fide_plugins.replica import Replica

__all__ = ["Lesson", "Model", "NotHereError"]

_ELSEWHERE = 10**6  # slots of trials that were begun before the generation and ask only now


class NotHereError(Exception):
    """The full features of an image are not in this process."""


Lesson = tuple[float, Tensor | None]
"""Loss of a trial, and the tokens (T, C) of its image if they are known."""


class Model:
    """A replica for one search space.

    space: of the parameters that it gives.
    make: makes its optimizer.
    history: what is known of the study's trials.
    digest: of space and settings; models are one if it is equal.
    """

    def __init__(
        self, space: Space, make: Callable[[], FIDE], history: History, digest: str
    ) -> None:
        self.space, self.digest = space, digest
        self._make, self._history = make, history
        self.shared = False
        """Whether it learns from features as they are stored, as everybody can, and not as full
        as this process has seen them."""
        self.forget()

    def forget(self) -> None:
        """Begin at the first trial again."""
        self._replica = Replica(self._make(), self.space.snap)
        self._log = Log(self._history)
        self._first = 0  # number of the trial whose slot is 0
        self._begins = [0]  # generations in which a search, probes or scouts began
        self.counts: Counter[str] = Counter()
        """How many trials counted as what; see `fide_plugins.replica`."""

    @property
    def at(self) -> int:
        """Trials of lower numbers were told, never will be, or are late."""
        return self._log.next

    def is_over(self, number: int) -> bool:
        """Whether a trial was told, or never will be."""
        return self._log.is_over(number)

    def catch_up(
        self, trials: Trials, lesson: Callable[[FrozenTrial, bool], Lesson | None]
    ) -> None:
        """Tell what has finished.

        lesson: what there is to learn from a trial, None for nothing; its second argument says
            whether from what is stored only; raises NotHereError if that would be needed.
        """
        try:
            self._read(trials, lesson)
        except NotHereError:
            self.shared = True
            self.forget()
            self._read(trials, lesson)

    def _read(self, trials: Trials, lesson: Callable[[FrozenTrial, bool], Lesson | None]) -> None:
        for trial in self._log.ready(trials):
            learned = lesson(trial, self.shared) if self.space.holds(trial) else None
            if learned is None:
                self.counts["left out"] += 1
            else:
                self._tell(trial, *learned)

    def _tell(self, trial: FrozenTrial, loss: float, tokens: Tensor | None) -> None:
        ask = self._history.ask_of(trial)
        name: dict[str, Any] = {}
        if ask is not None and ask.model == self.digest:
            name = {"generation": ask.generation, "slot": ask.slot, "proposed": ask.proposed}
        generation = self._replica.generation
        began = self._history.began(self.digest, generation + 1)
        over = None if began is None else began == generation + 1
        x = self.space.encode(trial.params)
        if trial.number == 0 and self._replica.is_candidate(0, x):  # see `first`
            name = {"generation": 0, "slot": 0}
        role = self._replica.tell(x, loss, tokens, over=over, **name)
        self.counts[role.value] += 1
        self.counts["image"] += tokens is not None
        if self._replica.generation != generation:
            self._first = max(self._log.next, trial.number + 1)
            if self._replica.began != self._begins[-1]:
                self._begins.append(self._replica.began)

    def agrees(self, news: News) -> bool:
        """Whether nothing new contradicts what was told so far."""
        if any(number < self.at for number in news.passed):
            return False  # it was told in its place, and counts later
        return all(
            began == max(begin for begin in self._begins if begin <= generation)
            for model, generation, began in news.began
            if model == self.digest and generation <= self._replica.generation
        )

    def stop_waiting(
        self,
        trials: Trials,
        number: int,
        lesson: Callable[[FrozenTrial, bool], Lesson | None],
    ) -> list[int]:
        """Pass trials before `number` that take too long, go on, and say which they were."""
        passed: list[int] = []
        while len(passed) < MOST_NAMED:
            overdue = self._log.overdue(trials, self._replica.size)
            overdue = [n for n in overdue if n < number][: MOST_NAMED - len(passed)]
            if not overdue:
                break
            passed += overdue
            self._history.stop_waiting(overdue)
            self.catch_up(trials, lesson)
        return passed

    def ask(
        self, trials: Trials, number: int, passed: list[int], late: list[int]
    ) -> tuple[Ask, dict[str, Any]]:
        """Record and parameters of trial `number`."""
        slot = number - self._first if number >= self._first else _ELSEWHERE + number
        candidate = self._replica.newest(slot, self._log.out(trials, number))
        ask = Ask(
            self.digest,
            self._replica.generation,
            slot,
            self._replica.began,
            candidate.proposed,
            tuple(passed),
            tuple(late[:MOST_NAMED]),
        )
        return ask, self.space.decode(candidate.x)

    def __getstate__(self) -> Mapping[str, Any]:
        state = self.__dict__.copy()
        state["_replica"] = self._replica.state_dict()
        return state

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)
        self._replica = Replica.from_state(self._make(), state["_replica"], self.space.snap)
