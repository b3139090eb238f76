"""Storages, threads, and what is stored and read (acceptance points 5, 6, 7, 15)."""

from __future__ import annotations

import json
import math
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.storages import InMemoryStorage
from optuna.testing.storages import STORAGE_MODES, StorageSupplier
from optuna.trial import FrozenTrial, Trial, TrialState

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.images import BYTES, ImageEvaluator
from fide_adapters.optuna.storage import MOST_NAMED, Ask, read_ask, write_image
from fide_plugins import FIDE

from .conftest import Bench, state_of


@pytest.fixture(scope="module")
def in_memory() -> list[dict[str, Any]]:
    return params_in(optuna.storages.InMemoryStorage())


def params_in(storage: Any) -> list[dict[str, Any]]:
    sampler = FIDESampler(np.linspace(0, 1, 64).reshape(8, 8), seed=0, popsize=4)
    study = optuna.create_study(storage=storage, sampler=sampler)

    def objective(trial: Trial) -> float:
        x = trial.suggest_float("x", -1, 1)
        k = trial.suggest_int("k", 1, 1000, log=True)
        trial.suggest_categorical("c", ["a", "b", "c"])
        return sampler.tell_image(trial, np.full((8, 8), abs(x) * k / 1000))

    study.optimize(objective, n_trials=14)
    assert sampler.counts(study) == {"injected": 1, "member": 13, "image": 14}
    return [trial.params for trial in study.trials]


@pytest.mark.thorough
@pytest.mark.parametrize("mode", STORAGE_MODES)
def test_point_5_every_storage_gives_the_same(mode: str, in_memory: list[dict[str, Any]]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of the storages themselves
        with StorageSupplier(mode) as storage:
            assert params_in(storage) == in_memory


def size_of(attributes: dict[str, Any]) -> int:
    ours = {key: value for key, value in attributes.items() if key.startswith("fide:")}
    assert len(ours) == len(attributes)
    assert all(len(json.dumps(value)) <= 2045 for value in ours.values())
    return sum(len(key) + len(json.dumps(value)) for key, value in ours.items())


def test_point_6_two_kibibytes_a_trial_at_200_dimensions() -> None:
    target = np.random.default_rng(0).random((112, 112, 3))
    sampler = FIDESampler(target, seed=0)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(200)]
        return sampler.tell_image(trial, np.random.default_rng(int(1e9 * x[0])).random((112, 112)))

    study.optimize(objective, n_trials=8)
    sizes = [size_of(trial.system_attrs) for trial in study.trials]
    assert max(sizes) <= 2048
    code = "A" * (4 * math.ceil(BYTES / 3))  # in base64
    numbers = tuple(range(10**6 - MOST_NAMED, 10**6))
    worst = Ask("0" * 8, 10**6, 2 * 10**6, 10**6, True, numbers, numbers, False, "0" * 4).to_json()
    assert size_of({"fide:ask": worst, "fide:image": write_image("0" * 8, code, "0" * 4)}) <= 2048
    assert not study._storage.get_study_system_attrs(study._study_id)


def test_a_record_says_where_losses_only_began_a_search() -> None:
    ask = Ask("0" * 8, generation=3, slot=1, began=2, guided=False)
    assert ask.to_json()["a"] == 1 and read_ask(ask.to_json()) == ask
    guided = Ask("0" * 8, generation=3, slot=1, began=2)
    assert "a" not in guided.to_json() and read_ask(guided.to_json()) == guided


def test_point_7_eight_threads(bench: Bench) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bench.run(study, 120, n_jobs=8)
    assert all(t.state is TrialState.COMPLETE for t in study.trials)
    images = ImageEvaluator(lambda: FIDE(5, bench.target).evaluator)
    for trial in study.trials:  # every feature belongs to its own trial
        image = bench.render([trial.params[name] for name in bench.names])
        code = trial.system_attrs["fide:image"]["d"]
        assert code == images.codec.pack(images.tokens(image[None]))
    counts = sampler.counts(study)
    waiting = counts.get("waiting", 0)  # overdue ones, which count when the next one is asked
    assert counts["image"] + waiting == 120
    assert sum(counts.values()) - counts["image"] == 120
    assert len(state_of(study).features) <= waiting
    X = bench.points(study)
    assert len(np.unique(X, axis=0)) == 120


class Counting(list[FrozenTrial]):
    """A list that counts how often it is looked into."""

    looks = 0

    def __getitem__(self, index: Any) -> Any:
        Counting.looks += 1
        return super().__getitem__(index)

    def __iter__(self) -> Any:
        raise AssertionError("nobody looks at all trials")


class Elsewhere:
    """A storage that is not known to be in memory."""

    def __init__(self) -> None:
        self._real = InMemoryStorage()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
        trials = self._real.get_all_trials(study_id, deepcopy, states)
        return trials if states else Counting(trials)


class InMemory(InMemoryStorage):
    """The one that is, which nobody asks for all trials."""

    def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
        assert states is not None, "nobody looks at all trials"
        return super().get_all_trials(study_id, deepcopy, states)

    def get_trial(self, trial_id: int) -> FrozenTrial:
        Counting.looks += 1
        return super().get_trial(trial_id)


@pytest.mark.parametrize("make", [Elsewhere, InMemory])
def test_point_15_no_trial_is_looked_at_for_ever(bench: Bench, make: Callable[[], Any]) -> None:
    sampler = bench.sampler(search_space=bench.space)
    study = optuna.create_study(storage=make(), sampler=sampler)
    looks = []
    for _ in range(3):
        Counting.looks = 0
        bench.run(study, 60)
        looks.append(Counting.looks)
    assert 60 <= looks[0] <= 60 * 30 and looks[2] <= looks[0] + 20


def test_point_15_finished_trials_are_not_touched(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 20)
    before = pickle.dumps(study.get_trials(deepcopy=False))
    bench.run(study, 20)
    study.sampler.reseed_rng()
    assert pickle.dumps(study.get_trials(deepcopy=False)[:20]) == before
