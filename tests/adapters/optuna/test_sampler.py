"""The same everywhere, and the same again (acceptance points 2, 3 and 4)."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.trial import Trial

from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

from .conftest import Bench, asked_by_core, counts_of

ROUNDING = 1e-9
"""With two threads a product of several rows is not that of each row: by 3e-15 after 150 trials."""


@pytest.mark.parametrize("preset", ["fast", "balanced", "accurate"])
def test_point_4_one_worker_asks_what_the_core_asks(bench: Bench, preset: str) -> None:
    settings = {"preset": preset, "patience": 2}  # so little that it relocates
    study = optuna.create_study(sampler=bench.sampler(search_space=bench.space, **settings))
    bench.run(study, 150)
    asked = asked_by_core(bench, 150, **settings)
    np.testing.assert_allclose(bench.points(study), asked, rtol=0, atol=ROUNDING)
    assert counts_of(study) == {"member": 150, "image": 150}


@pytest.mark.parametrize("names", [[f"x{i}" for i in range(12)], ["a", "b", "c"]])
def test_point_4_without_a_given_space_it_is_the_same(bench: Bench, names: list[str]) -> None:
    sampler: FIDESampler = bench.sampler(popsize=None)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(name, 0, 1) for name in names]
        return sampler.tell_image(trial, bench.render(np.resize(x, 5)))

    study.optimize(objective, n_trials=60)
    core = FIDE(len(names), bench.target, seed=0, proposer="linear")
    asked = np.array([[trial.params[name] for name in names] for trial in study.trials])
    while core.evaluations < len(asked):
        X = core.ask()  # whole generations, as a replica hands them out
        i = core.evaluations
        np.testing.assert_allclose(
            asked[i : i + len(X)], X[: len(asked) - i], rtol=0, atol=ROUNDING
        )
        core.tell(X, np.stack([bench.render(np.resize(x, 5)) for x in X]))
    assert sampler.counts(study) == {"member": 60, "image": 60}


def test_point_4_same_seed_same_study(bench: Bench) -> None:
    runs = []
    for seed in (0, 0, 1):
        study = optuna.create_study(sampler=bench.sampler(seed=seed))
        bench.run(study, 40)
        runs.append(bench.points(study))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any(axis=1).all()


# -- points 2 and 3: seeds, copies -----------------------------------------------------------------


def mixed(trial: Trial) -> float:
    return float(
        trial.suggest_float("a", 1, 9)
        + trial.suggest_float("b", 1, 9, log=True)
        + trial.suggest_float("c", 1, 9, step=1)
        + trial.suggest_int("d", 1, 9)
        + trial.suggest_int("e", 1, 9, log=True)
        + trial.suggest_int("f", 1, 9, step=2)
        + trial.suggest_categorical("g", range(1, 10))
    )


def params_of(sampler: FIDESampler, constant: bool = False) -> list[dict[str, Any]]:
    study = optuna.create_study(sampler=sampler)
    study.optimize(lambda trial: 0.0 * mixed(trial) if constant else mixed(trial), n_trials=15)
    return [trial.params for trial in study.trials]


@pytest.mark.parametrize("constant", [False, True])
def test_point_2_reproducible(constant: bool) -> None:
    first = params_of(FIDESampler(seed=1), constant)
    assert params_of(FIDESampler(seed=1), constant) == first
    assert params_of(FIDESampler(seed=2), constant) != first


def test_point_2_reseeding_changes_what_is_sampled() -> None:
    sampler = FIDESampler(seed=1)
    sampler.reseed_rng()
    assert params_of(sampler) != params_of(FIDESampler(seed=1))


@pytest.mark.parametrize("how", ["pickle", "deepcopy"])
def test_point_3_a_copy_goes_on_as_if_nothing_had_happened(bench: Bench, how: str) -> None:
    study = optuna.create_study(sampler=bench.sampler(patience=2))
    bench.run(study, 30)
    sampler = study.sampler
    copied = pickle.loads(pickle.dumps(sampler)) if how == "pickle" else copy.deepcopy(sampler)
    again = copy.deepcopy(study)
    again.sampler = copied
    bench.run(study, 30)
    bench.run(again, 30)
    np.testing.assert_array_equal(bench.points(again), bench.points(study))
    assert counts_of(study)["image"] == 60
