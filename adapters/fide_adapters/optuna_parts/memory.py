"""What a sampler remembers of one study; all of it but full features can be read again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.storages import BaseStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState
from torch import Tensor

from fide_adapters.optuna_parts.eye import Eye
from fide_adapters.optuna_parts.history import History, Trials
from fide_adapters.optuna_parts.losses import loss_of
from fide_adapters.optuna_parts.model import Lesson, Model, NotHereError
from fide_adapters.optuna_parts.reader import Reader
from fide_adapters.optuna_parts.records import ASK, IMAGE, SEED, is_seed, read_image
from fide_adapters.optuna_parts.relative import RelativeSpace
from fide_adapters.optuna_parts.settings import Settings
from fide_adapters.optuna_parts.space import Space

__all__ = ["Memory"]

_MOST_MODELS = 4
_MOST_WAITING = 1000  # trials; none waits as long as that while this sampler is in use
_YOUNG = 64  # trials; in a study with more, all workers have read the same seed


class Memory:
    """Of one study."""

    def __init__(self, study: Study, settings: Settings) -> None:
        self.tokens: dict[int, Tensor] = {}
        """Full features (T, C) of trials that were not told yet, by number."""
        self._settings = settings
        self._storage: BaseStorage | None = study._storage
        self._study = (study._study_id, study.study_name)
        self._reader = Reader()
        self._trials: Trials = []
        self._seed = settings.seed
        self._history = History(self._settings.voice)
        self._relative = RelativeSpace(self._settings.voice)
        self._models: OrderedDict[str, Model] = OrderedDict()
        self._distributions: dict[str, BaseDistribution] = {}  # that were asked for last
        self._space, self._digest = Space({}), ""

    def is_of(self, study: Study) -> bool:
        """Whether this is the study; a restored sampler takes the one of the same name for it."""
        if self._storage is None and self._study == (study._study_id, study.study_name):
            self._storage = study._storage
        return self._storage is study._storage and self._study[0] == study._study_id

    # -- before a trial ----------------------------------------------------------------------------

    def look(self, study: Study, number: int = 0) -> RelativeSpace:
        """Read what is new in the storage; say what trials before that number had in common."""
        self._trials = self._reader.read(study)
        news = self._history.update(self._trials)
        for trial in news.finished:
            self._relative.add(trial)
        if not self._relative.completed:
            before = (t for t in self._trials[:number] if t.state is TrialState.RUNNING)
            self._relative.begin(next((t.distributions for t in before if t.params), {}))
        for model in self._models.values():
            if not model.agrees(news):
                model.forget()
        self._agree_on_seed(study)
        return self._relative

    def _agree_on_seed(self, study: Study) -> None:
        """Without a seed of its own, a sampler uses the study's, and makes one if there is none."""
        young = self._seed is None or len(self._trials) < _YOUNG
        if self._settings.seed is not None or not young:
            return
        storage = study._storage
        seed = storage.get_study_system_attrs(study._study_id).get(SEED)
        if not is_seed(seed):
            if seed is not None:
                self._settings.voice.warn(
                    SEED, f"the study's attribute {SEED!r} is not ours, and is replaced"
                )
            seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(11))
            storage.set_study_system_attr(study._study_id, SEED, seed)
            seed = storage.get_study_system_attrs(study._study_id)[SEED]
        if seed != self._seed:
            self._seed = seed
            self._models.clear()

    def first(
        self, study: Study, trial: FrozenTrial, name: str, distribution: BaseDistribution
    ) -> Any:
        """Value of a parameter of the first trial, when no search space is known.

        It is that of the first candidate there will be: of coordinates that are independent, the
        first ones are the same whatever their number.  (If parameters are suggested in another
        order than `Space` has, it is just a candidate of the same distribution.)
        """
        self._agree_on_seed(study)
        before, space = Space(trial.distributions).dim, Space({name: distribution})
        optimizer = self._settings.recipe.make(before + space.dim, self._seed or 0)
        return space.decode(optimizer.ask(1)[0, before:])[name]

    def ask(
        self, study: Study, trial: FrozenTrial, distributions: Mapping[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Parameters of a trial, after writing down which candidate it is."""
        self._search(distributions)
        if self._space.dim == 0:
            return self._space.decode(np.empty(0))
        if trial.number >= len(self._trials):
            self.look(study)
        model = self._model()
        lesson = partial(self._lesson, study)
        model.catch_up(self._trials, lesson)
        passed = model.stop_waiting(self._trials, trial.number, lesson)
        self._drop_tokens(model)
        late = [n for n in self._history.uncounted(self._trials) if n < trial.number]
        ask, params = model.ask(self._trials, trial.number, passed, late)
        study._storage.set_trial_system_attr(trial._trial_id, ASK, ask.to_json())
        return params

    def _search(self, distributions: Mapping[str, BaseDistribution]) -> None:
        """Make these the present search space."""
        if distributions != self._distributions:
            self._distributions, self._space = dict(distributions), Space(distributions)
            self._digest = self._settings.recipe.digest_of(self._space.distributions)

    def _model(self) -> Model:
        digest = self._digest
        model = self._models.get(digest)
        if model is None:
            make = partial(self._settings.recipe.make, self._space.dim, self._seed or 0)
            model = self._models[digest] = Model(self._space, make, self._history, digest)
        self._models.move_to_end(digest)
        while len(self._models) > _MOST_MODELS:
            self._models.popitem(last=False)
        return model

    def _lesson(self, study: Study, trial: FrozenTrial, shared: bool) -> Lesson | None:
        """Loss and tokens of a finished trial."""
        settings = self._settings
        loss = loss_of(study, trial, settings.consider_pruned, settings.voice)
        if loss is None:
            return None
        if self._settings.eye is None:
            return loss, None
        if not shared and trial.number in self.tokens:
            return loss, self.tokens[trial.number]
        record = trial.system_attrs.get(IMAGE)
        if record is None:
            return loss, self.from_artifact(study, trial)
        stored = self._stored(trial.number, record, self._settings.eye)
        if stored is not None and not shared:
            raise NotHereError
        return loss, stored

    def _stored(self, number: int, record: Any, eye: Eye) -> Tensor | None:
        code = read_image(record, eye.codec.digest)
        tokens = None if code is None else eye.codec.unpack(code)
        if tokens is None:
            self._settings.voice.warn(
                IMAGE,
                f"the attribute {IMAGE!r} of trial {number} is not of this target and encoder, so "
                "the trial counts without its image",
            )
        return tokens

    def from_artifact(self, study: Study, trial: FrozenTrial) -> Tensor | None:
        """Tokens of the image in the artifact store, if there is one."""
        eye, artifacts = self._settings.eye, self._settings.artifacts
        if eye is None or artifacts is None:
            return None
        image = artifacts.load(trial, study._storage, eye.target.shape)
        return None if image is None else eye.tokens(image)

    def _drop_tokens(self, model: Model) -> None:
        """Forget features that were told."""
        for number in [n for n in self.tokens if model.is_over(n)]:
            del self.tokens[number]

    def keep(self, number: int, tokens: Tensor) -> None:
        """Remember the full features (T, C) of a trial until they are told."""
        self.tokens[number] = tokens
        if len(self.tokens) > _MOST_WAITING:
            del self.tokens[min(self.tokens)]

    def counts(
        self, study: Study, distributions: Mapping[str, BaseDistribution] | None
    ) -> dict[str, int]:
        """How many trials counted as what, in the search space that was asked for last.

        distributions: the search space, if nothing was asked; None: what trials have in common.
        """
        relative = self.look(study)
        if not self._distributions:
            self._search(relative.current if distributions is None else distributions)
        if self._space.dim == 0:
            return {}
        model = self._model()
        model.catch_up(self._trials, partial(self._lesson, study))
        self._drop_tokens(model)
        done = (t.number for t in self._trials if t.state is TrialState.COMPLETE)
        waiting = sum(not model.is_over(number) for number in done)
        return {**model.counts, **({"waiting": waiting} if waiting else {})}

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_storage": None, "_trials": []}
