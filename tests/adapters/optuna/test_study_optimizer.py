"""Several workers on one study, taking turns in one process (acceptance point 8)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.storages import InMemoryStorage
from optuna.trial import FrozenTrial, Trial, TrialState

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.replica import Replica
from fide_adapters.optuna.study import StudyOptimizer
from fide_plugins import FIDE

from .conftest import Bench, counts_of, state_of


class LaggingStorage:
    """What one worker sees of a storage: sometimes what it saw the time before."""

    def __init__(self, real: InMemoryStorage, rng: np.random.Generator, lag: float) -> None:
        self._real, self._rng, self.lag = real, rng, lag
        self._last: list[FrozenTrial] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def get_all_trials(
        self, study_id: int, deepcopy: bool = True, states: Any = None
    ) -> list[FrozenTrial]:
        trials = self._real.get_all_trials(study_id, deepcopy, states)
        if states is not None:
            return trials
        if self._rng.random() < self.lag and self._last:
            # but whoever has begun a trial sees that it has
            return self._last + trials[len(self._last) :]
        self._last = trials
        return trials


class Crowd:
    """Workers that ask, render for a while, and tell, in an order drawn at random."""

    def __init__(self, bench: Bench, workers: int, seed: int, lag: float = 0.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.storage = InMemoryStorage()
        optuna.create_study(storage=self.storage, study_name="crowd")
        self.bench, self.lag = bench, lag
        self.studies = [self.join() for _ in range(workers)]
        self.running: dict[int, tuple[optuna.Study, Trial]] = {}

    def join(self, **settings: Any) -> optuna.Study:
        sampler = self.bench.sampler(search_space=self.bench.space, **settings)
        storage: Any = self.storage
        if self.lag:
            storage = LaggingStorage(self.storage, self.rng, self.lag)
        return optuna.load_study(study_name="crowd", storage=storage, sampler=sampler)

    def ask(self, worker: int) -> None:
        study = self.studies[worker]
        trial = study.ask()
        x = self.bench.suggest(trial)
        loss = self.bench.sampler_of(study).tell_image(trial, self.bench.render(x))
        trial.set_user_attr("value", loss)
        self.running[worker] = (study, trial)

    def finish(self, worker: int) -> None:
        study, trial = self.running.pop(worker)
        study.tell(trial, trial.user_attrs["value"])

    def work(self, trials: int, dies: float = 0.0, slow: float = 0.0) -> None:
        """So many trials are begun; some workers die in one, some take ten times as long."""
        patience = dict.fromkeys(range(len(self.studies)), 0)
        for _ in range(trials):
            worker = int(self.rng.integers(len(self.studies)))
            if worker in self.running:
                if patience[worker] > 0:
                    patience[worker] -= 1
                    continue
                if self.rng.random() < dies:
                    del self.running[worker]  # it is never told
                else:
                    self.finish(worker)
            self.ask(worker)
            patience[worker] = 10 if self.rng.random() < slow else 0

    def optimizers(self) -> list[StudyOptimizer]:
        """What each worker believes when it has seen everything."""
        return [optimizer_of(study) for study in self.studies]

    def completed(self) -> list[FrozenTrial]:
        return self.storage.get_all_trials(0, states=(TrialState.COMPLETE,))


def optimizer_of(study: optuna.Study) -> StudyOptimizer:
    if isinstance(study._storage, LaggingStorage):
        study._storage.lag = 0.0
    counts_of(study)
    return state_of(study).optimizer


def beliefs(optimizers: Sequence[StudyOptimizer]) -> list[tuple[Any, ...]]:
    return [
        (
            optimizer.at,
            optimizer.replica.generation,
            dict(optimizer.counts),
            optimizer.replica.candidate(0).x.tobytes(),
        )
        for optimizer in optimizers
    ]


def counted(optimizer: StudyOptimizer) -> int:
    return sum(optimizer.counts[role] for role in ("member", "altered", "late", "injected"))


@pytest.mark.parametrize("workers", [2, 4, 9])
def test_point_8_all_believe_the_same(bench: Bench, workers: int) -> None:
    crowd = Crowd(bench, workers, seed=0)
    crowd.work(80)
    for worker in list(crowd.running):
        crowd.finish(worker)
    optimizers = crowd.optimizers()
    learned = beliefs(optimizers)
    assert all(belief == learned[0] for belief in learned)
    assert optimizers[0].at == len(crowd.completed())
    assert counted(optimizers[0]) == len(crowd.completed())  # each once
    assert optimizers[0].counts["altered"] == 0
    if workers > 2:
        assert optimizers[0].counts["late"] > 0
    assert optimizers[0].counts["image"] == counted(optimizers[0])


@pytest.mark.parametrize("seed", range(2))
def test_the_dead_are_passed_and_nothing_is_lost(bench: Bench, seed: int) -> None:
    crowd = Crowd(bench, 4, seed)
    crowd.work(160, dies=0.03, slow=0.05)
    for worker in list(crowd.running):
        crowd.finish(worker)
    for worker in range(4):  # everybody asks once more, so that what is late finds a place
        crowd.ask(worker)
        crowd.finish(worker)
    optimizers = crowd.optimizers()
    learned = beliefs(optimizers)
    assert all(belief == learned[0] for belief in learned)
    complete = len(crowd.completed())
    waiting = [t.number for t in crowd.storage.get_all_trials(0) if t.number >= optimizers[0].at]
    assert complete - len(waiting) <= counted(optimizers[0]) <= complete
    assert len(waiting) < 60


@pytest.mark.parametrize("seed", range(2))
def test_point_8_who_sees_things_later_comes_to_the_same(bench: Bench, seed: int) -> None:
    """Old snapshots make workers disagree on who is passed, until they have read the records."""
    crowd = Crowd(bench, 5, seed, lag=0.5)
    crowd.work(160, dies=0.02, slow=0.15)
    optimizers = crowd.optimizers()
    learned = beliefs(optimizers)
    assert all(belief == learned[0] for belief in learned)


def test_point_8_a_late_trial_counts_once(bench: Bench) -> None:
    crowd = Crowd(bench, 2, 0)
    crowd.ask(0)
    for _ in range(4):
        crowd.ask(1)
        crowd.finish(1)
    study = crowd.studies[1]
    assert bench.sampler_of(study).counts(study) == {"waiting": 4}
    for _ in range(36):
        crowd.ask(1)
        crowd.finish(1)
    before = optimizer_of(crowd.studies[1])
    assert before.at > 30  # trial 0 is not waited for
    late = before.counts["late"] + before.counts["injected"]
    crowd.finish(0)
    for _ in range(2):
        crowd.ask(1)
        crowd.finish(1)
    learned = beliefs(crowd.optimizers())
    assert learned[0] == learned[1]
    counts = crowd.optimizers()[0].counts
    assert counts["late"] + counts["injected"] == late + 1
    assert counted(crowd.optimizers()[0]) == 43


def workers_of_one_study(bench: Bench, seeds: list[int | None]) -> list[optuna.Study]:
    storage = InMemoryStorage()
    samplers = [bench.sampler(seed=seed, search_space=bench.space) for seed in seeds]
    shared: dict[str, Any] = {"study_name": "s", "storage": storage, "load_if_exists": True}
    return [optuna.create_study(sampler=sampler, **shared) for sampler in samplers]


def test_after_an_interrupt_no_trial_is_told_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    tell, told = Replica.tell, []

    def interrupted(*given: Any, **more: Any) -> Any:
        role = tell(*given, **more)
        told.append(role)
        if len(told) == 20:
            raise KeyboardInterrupt
        return role

    def objective(trial: Trial) -> float:
        return sum(trial.suggest_float(name, 0, 1) ** 2 for name in "abc")

    study = optuna.create_study(sampler=FIDESampler(seed=0))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Replica, "tell", interrupted)
        study.optimize(objective, n_trials=60)
    study.optimize(objective, n_trials=60)
    complete = sum(trial.state is TrialState.COMPLETE for trial in study.trials)
    assert counted(optimizer_of(study)) == complete >= 60
    assert optimizer_of(study).replica.optimizer.evaluations == complete
    fresh = optuna.load_study(
        study_name=study.study_name, storage=study._storage, sampler=FIDESampler(seed=0)
    )
    fresh.optimize(objective, n_trials=1)
    assert "altered" not in counts_of(fresh)


def test_workers_without_a_seed_share_one(bench: Bench) -> None:
    studies = workers_of_one_study(bench, [None, None, None])
    for _ in range(10):
        for study in studies:
            bench.run(study, 1)
    learned = beliefs([optimizer_of(study) for study in studies])
    assert learned[0] == learned[1] == learned[2]
    assert learned[0][2].get("altered", 0) == 0


def test_point_9_a_batch_of_an_unknown_space(bench: Bench) -> None:
    """Trials that are asked before any was told are candidates of the first generation."""
    study = optuna.create_study(sampler=bench.sampler())
    sampler = bench.sampler_of(study)
    asked = [(trial, bench.suggest(trial)) for trial in (study.ask() for _ in range(6))]
    for trial, x in asked:
        study.tell(trial, sampler.tell_image(trial, bench.render(x)))
    assert sampler.counts(study) == {"member": 6, "image": 6}
    core = FIDE(5, bench.target, seed=0, popsize=6)
    np.testing.assert_allclose(bench.points(study), core.ask(6), rtol=0, atol=1e-15)
