"""What a sampler knows of its studies, and the optimizer of each search space.

It can be read again, except features in full precision.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from math import isclose, isfinite
from typing import Any, TypeAlias

import numpy as np
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState
from torch import Tensor

from fide_adapters.optuna import storage
from fide_adapters.optuna.images import ImageEvaluator
from fide_adapters.optuna.replica import Replica, Role
from fide_adapters.optuna.search_space import RelativeSpace, SearchSpace
from fide_adapters.optuna.settings import Settings
from fide_adapters.optuna.storage import (
    ASK,
    GUESS,
    IMAGE,
    MOST_NAMED,
    SEED,
    Ask,
    TrialReader,
    Trials,
)
from fide_adapters.optuna.trials import History, News, TrialOrder, loss_of
from fide_plugins.fide import FIDE
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64

__all__ = ["StudyOptimizer", "StudyState", "StudyStates"]

_MOST_STUDIES = 4
_MOST_OPTIMIZERS = 4
_MOST_FEATURES = 1000  # trials; none waits as long as that while this sampler is in use
_YOUNG = 64  # trials; beyond, all workers have read the same seed
_FIRST_DIM = 64  # parameters that the first trial is expected to have at most
_PROBLEM = "problem"  # subject of a warning
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
    """The replica of one search space, see `fide_adapters.optuna.replica`.

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


@dataclass
class _Read:
    """What was read of a study, by which it is known again through another connection.

    Studies of two storages may have the same number and name, and so may a study that was deleted
    and the one that was made after it.  But when a trial has begun does not change.

    trials: their number.
    last: number of a trial that had begun, one of the last, and when it began.
    """

    trials: int = 0
    last: tuple[int, datetime] | None = None

    def note(self, trials: Trials, finished: list[FrozenTrial]) -> None:
        """Note that these were read, and which of them have finished since the last time."""
        self.trials = len(trials)
        for trial in (*finished, *trials[-1:]):  # an enqueued one has not begun
            began = trial.datetime_start
            if began is not None and (self.last is None or trial.number > self.last[0]):
                self.last = trial.number, began

    def fits(self, trials: Trials) -> bool:
        """Whether these can be the trials that were read, and perhaps more."""
        if len(trials) < self.trials:
            return False
        return self.last is None or trials[self.last[0]].datetime_start == self.last[1]


class StudyState:
    """The state of a sampler in one study."""

    def __init__(self, study: Study, settings: Settings) -> None:
        self._settings = settings
        self._storage: object = storage.storage_of(study)
        self._study = storage.id_of(study)
        self._begin()

    def _begin(self) -> None:
        """Know nothing of the study."""
        settings = self._settings
        self.features: dict[int, Tensor] = {}
        """Features (T, C), in full precision, of trials that are not processed, by number."""
        self._read = _Read()
        self._reader = TrialReader()
        self._trials: Trials = []
        self._seed = settings.seed
        self._history = History(settings.warnings, settings.problem)
        self._relative = RelativeSpace(settings.warnings)
        self._optimizers: OrderedDict[str, StudyOptimizer] = OrderedDict()
        self._first = np.empty(0)  # coordinates of the first candidate
        self._distributions: dict[str, BaseDistribution] = {}  # the latest search space
        self._space, self._digest = SearchSpace({}), ""

    def is_of(self, study: Study) -> bool:
        """Whether this is the study, through the same connection."""
        same_storage = self._storage is storage.storage_of(study)
        return same_storage and self._study == storage.id_of(study)

    def resume(self, study: Study) -> bool:
        """Go on with the study through another connection, or after unpickling, if this is it."""
        if self._study != storage.id_of(study):
            return False
        if self._read.fits(TrialReader().read(study)):
            self._storage = storage.storage_of(study)
            self._reader, self._trials = TrialReader(), []
            return True
        if self._storage is None:
            self._warn_of_another_study()
        return False

    def _warn_of_another_study(self) -> None:
        if self._relative.completed:
            self._settings.warnings.warn(
                "study",
                f"the study {self._study[1]!r} has other trials than that of this name which the "
                "sampler has learned from; the sampler uses nothing of what it knows of those",
            )

    # -- before a trial ----------------------------------------------------------------------------

    def update(self, study: Study, number: int = 0) -> RelativeSpace:
        """Read what is new in the storage; returns the search space of trials before `number`."""
        self._trials = self._reader.read(study)
        if not self._read.fits(self._trials):  # it was deleted, and made again
            self._warn_of_another_study()
            self._begin()
            self._trials = self._reader.read(study)
        news = self._history.update(self._trials)
        self._read.note(self._trials, news.finished)
        for trial in news.finished:
            self._relative.add(trial)
        if not self._relative.completed:
            before = (t for t in self._trials[:number] if t.state is TrialState.RUNNING)
            self._relative.begin(next((t.distributions for t in before if t.params), {}))
        for optimizer in self._optimizers.values():
            if not optimizer.agrees(news):
                optimizer.restart()
        self._agree_on_seed(study)
        return self._relative

    def _agree_on_seed(self, study: Study) -> None:
        """Without a seed of its own, a sampler uses the study's, and draws it if there is none."""
        young = self._seed is None or len(self._trials) < _YOUNG
        if self._settings.seed is not None or not young:
            return
        seed, valid = storage.read_seed(study)
        if not valid:
            self._settings.warnings.warn(
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

        It is that of the first candidate of the search, as far as parameters are floats that are
        suggested in the order of `SearchSpace`; otherwise it belongs to another candidate.
        """
        self._agree_on_seed(study)
        before, space = SearchSpace(trial.distributions).dim, SearchSpace({name: distribution})
        needed = before + space.dim
        if len(self._first) < needed:  # the first coordinates are the same for any number of floats
            numbers = {f"p{i}": Float(0, 1) for i in range(max(_FIRST_DIM, 2 * needed))}
            self._first = self._settings.first_candidate(Space(numbers), self._seed or 0)
        return space.decode(self._first[before:needed])[name]

    def ask(
        self, study: Study, trial: FrozenTrial, distributions: Mapping[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Parameters of a trial; writes into the trial which candidate they are."""
        if trial.number >= len(self._trials):
            self.update(study)
        self._search(distributions)
        if self._space.dim == 0:
            return self._space.decode(np.empty(0))
        optimizer = self._optimizer()
        evaluation = partial(self._evaluation, study)
        optimizer.process(self._trials, evaluation)
        skipped = optimizer.skip_overdue(self._trials, trial.number, evaluation)
        self._warn_without_images()
        self._release_features(optimizer)
        late = [n for n in self._history.uncounted(self._trials) if n < trial.number]
        ask, params = optimizer.ask(self._trials, trial.number, skipped, late)
        record = replace(ask, problem=self._settings.problem).to_json()
        storage.write_attribute(storage.storage_of(study), trial, ASK, record)
        return params

    def _warn_without_images(self) -> None:
        optimizers = self._optimizers.values()
        if self._settings.images is not None and all(o.lacks_images for o in optimizers):
            self._settings.warnings.warn(
                "images",
                "FIDESampler has a target and gets no images, so it is CMA-ES; return "
                "sampler.tell_image(trial, image) from the objective, or make the sampler without "
                "a target",
            )

    def _search(self, distributions: Mapping[str, BaseDistribution]) -> None:
        """Make these the current search space."""
        if distributions != self._distributions:
            self._distributions, self._space = dict(distributions), SearchSpace(distributions)
            self._digest = self._settings.digest_of(self._space.distributions)

    def _optimizer(self) -> StudyOptimizer:
        """Optimizer of the current search space; of those used least recently some are dropped."""
        digest = self._digest
        optimizer = self._optimizers.get(digest)
        if optimizer is None:
            seed, guess = self._seed or 0, self._guess()
            assert self._space.space is not None  # else there is nothing to search
            make = partial(self._settings.make, self._space.space, seed, guess)
            optimizer = StudyOptimizer(self._space, make, self._history, digest)
            self._optimizers[digest] = optimizer
        self._optimizers.move_to_end(digest)
        while len(self._optimizers) > _MOST_OPTIMIZERS:
            self._optimizers.popitem(last=False)
        return optimizer

    def _guess(self) -> Float64 | None:
        """Point (dim,) of the first trial, if a user has enqueued it with all parameters.

        None where another sampler ran that trial: its trials may know better.  Another trial may be
        enqueued at any time, and workers would not agree when.
        """
        first = self._trials[0]
        enqueued = storage.enqueued_in(first) if GUESS in first.system_attrs else {}
        return self._space.encode(enqueued) if self._space.contains(enqueued) else None

    # -- results -----------------------------------------------------------------------------------

    def _evaluation(self, study: Study, trial: FrozenTrial, only_stored: bool) -> Evaluation | None:
        """Loss and features of a finished trial; None if it does not count.

        only_stored: whether to use features only as they are stored.
        Raises StoredFeaturesNeeded if the features are known only as they are stored.
        """
        settings = self._settings
        loss = loss_of(study, trial, settings.consider_pruned, settings.warnings)
        if loss is None:
            return None
        if self._is_of_another_problem(trial):
            self._warn_of_another_problem()
            return None
        if settings.images is None:
            return loss, None
        if not only_stored and trial.number in self.features:
            return loss, self.features[trial.number]
        record = trial.system_attrs.get(IMAGE)
        if record is None:
            return loss, self.from_artifact(study, trial)
        stored = self._stored(trial.number, record, settings.images)
        if stored is not None and not only_stored:
            raise StoredFeaturesNeeded
        return loss, stored

    def _is_of_another_problem(self, trial: FrozenTrial) -> bool:
        """Whether the loss is a distance from another target, or by another loss.

        A trial that does not say it counts: others than `FIDESampler` or earlier versions made it.
        """
        own, named = self._settings.problem, storage.problems_of(trial)
        return own is not None and bool(named) and own not in named

    def _warn_of_another_problem(self) -> None:
        warnings = self._settings.warnings
        if _PROBLEM in warnings.subjects:
            return  # all trials are looked at for the message, once
        finished = (trial for trial in self._trials if trial.state.is_finished())
        of_others = [trial.number for trial in finished if self._is_of_another_problem(trial)]
        warnings.warn(
            _PROBLEM,
            f"{_named(of_others)} scored against another target, or by another loss, and left "
            "out; study.best_trial may be one of them: start a new study for each target and loss",
        )

    def _stored(self, number: int, record: Any, images: ImageEvaluator) -> Tensor | None:
        code = storage.read_image(record, images.codec.digest)
        tokens = None if code is None else images.codec.unpack(code)
        if tokens is None:
            self._settings.warnings.warn(
                IMAGE,
                f"the attribute {IMAGE!r} of trial {number} does not belong to this target and "
                "encoder, so the trial counts without its image",
            )
        return tokens

    def from_artifact(self, study: Study, trial: FrozenTrial) -> Tensor | None:
        """Features of the trial's image in the artifact store, if there is one."""
        images, artifacts = self._settings.images, self._settings.artifacts
        if images is None or artifacts is None:
            return None
        image = artifacts.load(trial, storage.storage_of(study), images.evaluator.views)
        return None if image is None else images.tokens(image)

    def keep(self, number: int, tokens: Tensor) -> None:
        """Keep the features (T, C) of a trial in full precision until it is processed."""
        self.features[number] = tokens
        if len(self.features) > _MOST_FEATURES:
            del self.features[min(self.features)]

    def _release_features(self, optimizer: StudyOptimizer) -> None:
        for number in [n for n in self.features if optimizer.is_processed(n)]:
            del self.features[number]

    def counts(
        self, study: Study, distributions: Mapping[str, BaseDistribution] | None
    ) -> dict[str, int]:
        """How many trials counted as what, in the latest search space.

        distributions: the search space, if none was asked for yet; None: the relative one.
        """
        relative = self.update(study)
        if not self._distributions:
            self._search(relative.current if distributions is None else distributions)
        if self._space.dim == 0 or not self._trials:
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
        return {**self.__dict__, "_storage": None, "_trials": []}


class StudyStates:
    """The states of a sampler in the studies that it was used in last; others are read again."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._states: list[StudyState] = []  # the latest at the end

    def of(self, study: Study) -> StudyState:
        """State in a study."""
        known = next((state for state in self._states if state.is_of(study)), None)
        known = known or next((s for s in reversed(self._states) if s.resume(study)), None)
        if known is None:
            known = StudyState(study, self._settings)
        self._states = [state for state in self._states if state is not known]
        self._states = [*self._states[1 - _MOST_STUDIES :], known]
        return known


def _named(numbers: list[int]) -> str:
    """Subject and verb of a sentence about trials, in ascending order."""
    first, last = numbers[0], numbers[-1]
    if first == last:
        return f"trial {first} was"
    if len(numbers) == last - first + 1:
        return f"trials {first}-{last} were"
    return f"{len(numbers)} of the trials {first}-{last} were"
