"""The same everywhere, and the same again (acceptance points 2, 3 and 4)."""

from __future__ import annotations

import copy
import json
import os
import pickle
import subprocess
import sys
from collections import Counter
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.distributions import FloatDistribution
from optuna.samplers import RandomSampler
from optuna.trial import Trial

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.settings import Settings
from fide_plugins import FIDE, encoders

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
    core = FIDE(len(names), bench.target, seed=0)
    asked = np.array([[trial.params[name] for name in names] for trial in study.trials])
    while core.evaluations < len(asked):
        X = core.ask()  # whole generations, as a replica hands them out
        i = core.evaluations
        np.testing.assert_allclose(
            asked[i : i + len(X)], X[: len(asked) - i], rtol=0, atol=ROUNDING
        )
        core.tell(X, np.stack([bench.render(np.resize(x, 5)) for x in X]))
    assert sampler.counts(study) == {"member": 60, "image": 60}


@pytest.mark.parametrize("target", [True, False])
def test_an_encoder_is_made_once_and_few_optimizers(
    bench: Bench, target: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in the first trial, whose 20 parameters are suggested one by one."""
    made: Counter[str] = Counter()
    make_encoder, make_optimizer = encoders.make, Settings.make

    def counted_encoder(*arguments: Any, **options: Any) -> Any:
        made["encoders"] += 1
        return make_encoder(*arguments, **options)

    def counted_optimizer(*arguments: Any, **options: Any) -> FIDE:
        made["optimizers"] += 1
        return make_optimizer(*arguments, **options)

    monkeypatch.setattr(encoders, "make", counted_encoder)
    monkeypatch.setattr(Settings, "make", counted_optimizer)
    sampler: FIDESampler = bench.sampler(target=bench.target if target else None)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(20)]
        image = bench.render(x[:5])
        return sampler.tell_image(trial, image) if target else float(image.mean())

    optuna.create_study(sampler=sampler).optimize(objective, n_trials=20)
    # an optimizer for the first trial, and one for the search
    assert made == {"encoders": 1 if target else 2, "optimizers": 2}


def test_groups_may_be_of_more_parameters_than_the_first_trial_expects(bench: Bench) -> None:
    """How many the first trial will have is not known when its first parameter is suggested."""
    names = [f"x{i}" for i in range(80)]
    groups = [list(range(5 * i, 5 * i + 5)) for i in range(16)]

    def run(**settings: Any) -> optuna.Study:
        sampler = bench.sampler(groups=groups, **settings)
        study = optuna.create_study(sampler=sampler)

        def objective(trial: Trial) -> float:
            x = [trial.suggest_float(name, 0, 1) for name in names]
            return sampler.tell_image(trial, bench.render(x))

        study.optimize(objective, n_trials=8)
        return study

    known = run(search_space={name: FloatDistribution(0, 1) for name in names})
    study = run()
    assert [t.params for t in study.trials] == [t.params for t in known.trials]
    assert counts_of(study) == {"member": 8, "image": 8}


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


def test_point_2_a_seed_of_more_than_32_bits_is_a_seed_as_in_fide() -> None:
    first = params_of(FIDESampler(seed=2**40, n_startup_trials=5))
    assert params_of(FIDESampler(seed=2**40, n_startup_trials=5)) == first
    others = params_of(FIDESampler(seed=0, n_startup_trials=5))
    assert all(one != other for one, other in zip(first, others, strict=True))


def test_point_2_reseeding_changes_what_is_sampled() -> None:
    sampler = FIDESampler(seed=1)
    sampler.reseed_rng()
    assert params_of(sampler) != params_of(FIDESampler(seed=1))


def test_point_2_reseeding_reaches_the_independent_sampler() -> None:
    independent = RandomSampler(seed=0)
    before = str(independent._rng.rng.get_state())
    sampler = FIDESampler(seed=0, independent_sampler=independent)
    sampler.reseed_rng()
    assert str(independent._rng.rng.get_state()) != before


ELSEWHERE = """
import json
import optuna
from fide_adapters.optuna import FIDESampler

optuna.logging.set_verbosity(optuna.logging.ERROR)
study = optuna.create_study(sampler=FIDESampler(seed=1))
study.optimize(lambda t: t.suggest_float("a", 0, 1) + t.suggest_int("g", 1, 3), n_trials=15)
print(json.dumps([[t.params for t in study.trials], hash("differs from process to process")]))
"""


@pytest.mark.thorough
def test_point_2_reproducible_in_another_process() -> None:
    run = [sys.executable, "-c", ELSEWHERE]
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=True)
    params, hashed = json.loads(done.stdout)
    study = optuna.create_study(sampler=FIDESampler(seed=1))
    study.optimize(lambda t: t.suggest_float("a", 0, 1) + t.suggest_int("g", 1, 3), n_trials=15)
    assert [t.params for t in study.trials] == params
    assert hash("differs from process to process") != hashed


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


def test_point_3_a_pickle_holds_no_image_and_no_lock(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 100)
    small = len(pickle.dumps(study.sampler))
    bench.run(study, 100)
    assert len(pickle.dumps(study.sampler)) < 1.2 * small
