"""What a sampler knows of a study, and the optimizer of each search space.

It can be read again, except features in full precision.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from math import isfinite
from typing import Any, TypeAlias

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState
from torch import Tensor

from fide_adapters.optuna import storage
from fide_adapters.optuna.replica import Replica, Role
from fide_adapters.optuna.search_space import Distributions, SearchSpace, common
from fide_adapters.optuna.settings import Settings
from fide_adapters.optuna.storage import IMAGE, MOST_NAMED, SEED, Ask, Trials
from fide_adapters.optuna.trials import History, News, TrialOrder, loss_of
from fide_plugins.fide import FIDE
from fide_plugins.space import Float, Space

_MOST_OPTIMIZERS = 4
_MOST_FEATURES = 1000  # trials; none waits as long as that while this sampler is in use
_YOUNG = 64  # trials; beyond, all workers have read the same seed
_FIRST_DIM = 64  # parameters that the first trial is expected to have at most
_OWN = (Role.MEMBER, Role.ALTERED, Role.LATE, Role.STEP)  # trials that were asked here
_EARLIER = 10**6  # first slot of trials that were created before the generation, but ask only now

Evaluation: TypeAlias = tuple[float, Tensor | None]
"""Loss of a trial, and the features (T, C) of its image if they are known."""

Evaluate: TypeAlias = Callable[[FrozenTrial, bool], Evaluation | None]
"""Evaluation of a finished trial, by stored features only if the second argument is true; None if
it does not count.  Raises StoredFeaturesNeeded if it is false and nothing else is known."""


class StoredFeaturesNeeded(Exception):
    """Features of an image are not in this process in full precision; no user sees this."""


class StudyOptimizer:
    """The replica of one search space, see `fide_adapters.optuna.replica`.

    make: makes its optimizer.
    digest: of search space and settings; workers with equal digests have the same optimizer.
    """

    def __init__(
        self, space: SearchSpace, make: Callable[[], FIDE], history: History, digest: str
    ) -> None:
        self.space, self.digest = space, digest
        self._make, self._history = make, history
        self._only_stored = False  # learns from features as all workers read them in the storage
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
        """Process the trials that have finished; after an exception begin again.

        Of a trial that was told in part nothing is known.
        """
        if self._broken:
            self.restart()
        self._broken = True
        try:
            self._process(trials, evaluate)
        except StoredFeaturesNeeded:
            self._only_stored = True
            self.restart()
            self._process(trials, evaluate)
        self._broken = False

    def _process(self, trials: Trials, evaluate: Evaluate) -> None:
        for trial in self._order.processable(trials):
            evaluation = evaluate(trial, self._only_stored) if self.space.holds(trial) else None
            if evaluation is None:
                self.counts["left out"] += 1
                ask = storage.read_ask(trial)
                if ask is not None and ask.step and ask.optimizer == self.digest:
                    self.replica.lose_step(ask.generation)
            else:
                self._tell(trial, *evaluation)

    def _tell(self, trial: FrozenTrial, loss: float, tokens: Tensor | None) -> None:
        ask = storage.read_ask(trial)
        name: dict[str, Any] = {}
        if ask is not None and ask.optimizer == self.digest:
            own = ("generation", "slot", "proposed", "step")
            name = {field: getattr(ask, field) for field in own}
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

    @property
    def lacks_images(self) -> bool:
        """Whether as many of its own as a generation has have a finite loss, and none an image."""
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
        """Skip trials before `number` that take too long, process what follows; their numbers."""
        skipped: list[int] = []
        while len(skipped) < MOST_NAMED:
            overdue = self._order.overdue(trials, self.replica.size)
            overdue = [n for n in overdue if n < number][: MOST_NAMED - len(skipped)]
            if not overdue:
                break
            skipped += overdue
            self._history.skip(overdue)
            self.process(trials, evaluate)
        return skipped

    def ask(
        self, trials: Trials, number: int, skipped: list[int], late: list[int]
    ) -> tuple[Ask, dict[str, Any]]:
        """Record and parameters of trial `number`."""
        slot = number - self._first if number >= self._first else _EARLIER + number
        replica, named = self.replica, (tuple(skipped), tuple(late[:MOST_NAMED]))
        pending = self._order.pending(trials, number)
        step = None if pending else replica.step(slot)  # which needs all results
        candidate = step or replica.newest(slot, pending)
        ask = Ask(
            self.digest, replica.generation, slot, replica.began, replica.guided,
            candidate.proposed, *named, step=step is not None,
        )  # fmt: skip
        return ask, self.space.decode(candidate.x)

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "replica": self.replica.state_dict()}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state)
        self.replica = Replica.from_state(self._make(), state["replica"], self.space.snap)


class StudyState:
    """The state of a sampler in one study."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._begin()

    def _begin(self) -> None:
        """Know nothing of the study."""
        self.features: dict[int, Tensor] = {}
        """Features (T, C), in full precision, of trials that are not processed, by number."""
        self._trials: Trials = []
        self._known = 0  # number of trials that were read
        self._start: datetime | None = None  # when trial 0 began
        self._seed = self._settings.seed
        self._history = History(self._settings.warn)
        self._common: Distributions | None = None  # what all completed trials have in common
        self.lost_space = False
        """Whether a trial has just left completed trials without a parameter in common."""
        self._optimizers: OrderedDict[str, StudyOptimizer] = OrderedDict()
        self._first = np.empty(0)  # coordinates of the first candidate
        self._given: dict[str, BaseDistribution] = {}  # the latest search space
        self._distributions: dict[str, BaseDistribution] = {}  # those of several values
        self._digest = ""

    # -- before a trial ----------------------------------------------------------------------------

    def update(self, study: Study, number: int = 0) -> Distributions:
        """Read what is new in the storage; returns the relative search space of trial `number`.

        Before any trial has completed, it is what the first running trial has so far.
        """
        self._read(study)
        news = self._history.update(self._trials)
        for trial in news.finished:
            if trial.state is TrialState.COMPLETE:
                before, kinds = self._common, trial.distributions
                if before is None or any(kinds.get(name) != d for name, d in before.items()):
                    self._common = common(kinds if before is None else before, kinds)
                    self.lost_space = bool(before) and not self._common
        for optimizer in self._optimizers.values():
            if not optimizer.agrees(news):
                optimizer.restart()
        self._agree_on_seed(study)
        if self._common is not None:
            return self._common
        running = (t for t in self._trials[:number] if t.state is TrialState.RUNNING and t.params)
        first = next(running, None)
        return {} if first is None else common(first.distributions, first.distributions)

    def _read(self, study: Study) -> None:
        """Read all trials; another study of the same name has another first trial."""
        self._trials = trials = storage.read_trials(study)
        start = trials[0].datetime_start if trials else None
        if len(trials) < self._known or self._start not in (None, start):
            self._begin()
            self._trials = trials
        self._known, self._start = len(trials), start

    def _agree_on_seed(self, study: Study) -> None:
        """Without a seed of its own, a sampler uses the study's, and draws it if there is none."""
        young = self._seed is None or len(self._trials) < _YOUNG
        if self._settings.seed is not None or not young:
            return
        seed, valid = storage.read_seed(study)
        if not valid:
            self._settings.warn(
                SEED,
                f"the study's attribute {SEED!r} was not written by FIDESampler, and is replaced",
            )
        if seed is None:
            seed = storage.write_seed(study)
        if seed != self._seed:
            self._seed = seed
            self._optimizers.clear()
            self._first = np.empty(0)

    def first(
        self, study: Study, trial: FrozenTrial, name: str, distribution: BaseDistribution
    ) -> Any:
        """Value of one parameter of the first trial, whose search space is not known yet.

        It is that of the first candidate of the search for floats in the order of `SearchSpace`.
        """
        self._agree_on_seed(study)
        space = SearchSpace({name: distribution})
        varied = common(trial.distributions, trial.distributions)
        before = SearchSpace(varied).space.dim if varied else 0
        needed = before + space.space.dim
        if len(self._first) < needed:  # the first coordinates are the same for any number of floats
            numbers = {f"p{i}": Float(0, 1) for i in range(max(_FIRST_DIM, 2 * needed))}
            # without groups, which are of the parameters of the study, and do not change this one
            optimizer = self._settings.make(Space(numbers), self._seed or 0, groups=None)
            self._first = optimizer.ask(1)[0]
        return space.decode(self._first[before:needed])[name]

    def ask(self, study: Study, trial: FrozenTrial, distributions: Distributions) -> dict[str, Any]:
        """Parameters of a trial; writes into the trial which candidate they are."""
        if trial.number >= len(self._trials):
            self.update(study)
        self._search(distributions)
        if not self._distributions:
            return {}
        optimizer = self._optimizer()
        evaluation = partial(self._evaluation, study)
        optimizer.process(self._trials, evaluation)
        skipped = optimizer.skip_overdue(self._trials, trial.number, evaluation)
        if self._settings.images is not None and optimizer.lacks_images:
            self._settings.warn(
                "images",
                "FIDESampler has a target and gets no images, so it is CMA-ES; return "
                "sampler.tell_image(trial, image) from the objective, or make the sampler without "
                "a target",
            )
        self._release_features(optimizer)
        late = [n for n in self._history.uncounted(self._trials) if n < trial.number]
        ask, params = optimizer.ask(self._trials, trial.number, skipped, late)
        ask = replace(ask, problem=self._settings.problem)
        storage.write_ask(storage.storage_of(study), trial, ask)
        return params

    def _search(self, distributions: Distributions) -> None:
        """Make these the current search space."""
        if distributions != self._given:
            self._given = dict(distributions)
            self._distributions = common(distributions, distributions)
            self._digest = self._settings.digest_of(self._distributions)

    def _optimizer(self) -> StudyOptimizer:
        """Optimizer of the current search space; of those used least recently some are dropped."""
        digest = self._digest
        optimizer = self._optimizers.get(digest)
        if optimizer is None:
            space = SearchSpace(self._distributions)
            # a user's guess; another trial may be enqueued at any time, so workers would not agree
            enqueued = self._trials[0].system_attrs.get("fixed_params")
            guess = space.encode(enqueued) if enqueued and space.contains(enqueued) else None
            make = partial(self._settings.make, space.space, self._seed or 0, guess)
            optimizer = StudyOptimizer(space, make, self._history, digest)
            self._optimizers[digest] = optimizer
        self._optimizers.move_to_end(digest)
        while len(self._optimizers) > _MOST_OPTIMIZERS:
            self._optimizers.popitem(last=False)
        return optimizer

    # -- results -----------------------------------------------------------------------------------

    def _evaluation(self, study: Study, trial: FrozenTrial, only_stored: bool) -> Evaluation | None:
        """Loss and features of a finished trial; None if it does not count."""
        settings = self._settings
        loss = loss_of(study, trial, settings.warn)
        if loss is None or self._is_of_another_problem(trial):
            return None
        if settings.images is None:
            return loss, None
        if not only_stored and trial.number in self.features:
            return loss, self.features[trial.number]
        if trial.system_attrs.get(IMAGE) is None:
            return loss, None
        codec = settings.images.codec
        code = storage.read_image(trial, codec.digest)
        stored = None if code is None else codec.unpack(code)
        if stored is None:
            settings.warn(
                IMAGE,
                f"the attribute {IMAGE!r} of trial {trial.number} does not belong to this target "
                "and encoder, so the trial counts without its image",
            )
        elif not only_stored:
            raise StoredFeaturesNeeded
        return loss, stored

    def _is_of_another_problem(self, trial: FrozenTrial) -> bool:
        """Whether the loss is a distance from another target, or by another loss."""
        own, scored_by = self._settings.problem, storage.problem_of(trial)
        if own is None or scored_by in (None, own):
            return False
        self._settings.warn(
            "problem",
            f"trial {trial.number} was scored against another target, or by another loss, and is "
            "left out, and so are others like it; study.best_trial may be one of them: start a new "
            "study for each target and loss",
        )
        return True

    def keep(self, number: int, tokens: Tensor) -> None:
        """Keep the features (T, C) of a trial in full precision until it is processed."""
        self.features[number] = tokens
        if len(self.features) > _MOST_FEATURES:
            del self.features[min(self.features)]

    def _release_features(self, optimizer: StudyOptimizer) -> None:
        for number in [n for n in self.features if optimizer.is_processed(n)]:
            del self.features[number]

    def counts(self, study: Study, distributions: Distributions | None) -> dict[str, int]:
        """How many trials counted as what, in the latest or else in this search space."""
        relative = self.update(study)
        if not self._distributions:
            self._search(relative if distributions is None else distributions)
        if not self._distributions or not self._trials:
            return {}
        optimizer = self._optimizer()
        optimizer.process(self._trials, partial(self._evaluation, study))
        self._release_features(optimizer)
        done = (t.number for t in self._trials if t.state is TrialState.COMPLETE)
        waiting = sum(not optimizer.is_processed(number) for number in done)
        return {**optimizer.counts, **({"waiting": waiting} if waiting else {})}

    @property
    def optimizer(self) -> StudyOptimizer:
        """Optimizer of the search space that was used last."""
        return next(reversed(self._optimizers.values()))

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_trials": []}
