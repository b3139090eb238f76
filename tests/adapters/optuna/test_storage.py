"""Storages, threads, and what is stored and read (acceptance points 5, 6, 7, 15)."""

from __future__ import annotations

import json
import warnings
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.testing.storages import STORAGE_MODES, StorageSupplier
from optuna.trial import Trial, TrialState

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.images import ImageEvaluator
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
    counts = sampler.counts(study)
    steps = counts.pop("step", 0)  # as many as rounding lets promise enough
    assert counts == {"injected": 1, "member": 13 - steps, "image": 14}
    return [trial.params for trial in study.trials]


@pytest.mark.thorough
@pytest.mark.parametrize("mode", STORAGE_MODES)
def test_point_5_every_storage_gives_the_same(mode: str, in_memory: list[dict[str, Any]]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of the storages themselves
        with StorageSupplier(mode) as storage:
            assert params_in(storage) == in_memory


def test_point_6_attributes_are_json_of_less_than_4_kib_a_trial(bench: Bench) -> None:
    """At 200 parameters and 224 x 224 pixels; trials that are read are left as they are."""
    target = np.kron(bench.target, np.ones((28, 28, 1), np.float32))
    sampler = FIDESampler(target, seed=0, popsize=4)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(200)]
        return sampler.tell_image(trial, np.roll(target, int(100 * x[0]), axis=1))

    study.optimize(objective, n_trials=6)
    before = [repr(trial) for trial in study.get_trials()]
    study.optimize(objective, n_trials=6)
    assert [repr(trial) for trial in study.get_trials()[:6]] == before
    for trial in study.trials:
        attributes = trial.system_attrs
        assert set(attributes) <= {"fide:ask", "fide:image"} and "fide:image" in attributes
        assert len(json.dumps(attributes)) < 4096


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
        code = trial.system_attrs["fide:image"]["code"]
        assert code == images.codec.pack(images.tokens(image[None]))
    counts = sampler.counts(study)
    waiting = counts.get("waiting", 0)  # overdue ones, which count when the next one is asked
    assert counts["image"] + waiting == 120
    assert sum(counts.values()) - counts["image"] == 120
    assert len(state_of(study).features) <= waiting
    X = bench.points(study)
    assert len(np.unique(X, axis=0)) == 120
