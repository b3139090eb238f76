"""Spaces that change, directions, constraints, other hands (acceptance points 11 to 14)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.samplers import PartialFixedSampler, RandomSampler
from optuna.trial import Trial, TrialState

from fide_adapters.optuna import FIDESampler, image_objective
from fide_plugins.errors import OptionError, ProtocolError

from .conftest import Bench, counts_of


def test_point_11_conditional_parameters(bench: Bench) -> None:
    study = optuna.create_study(sampler=FIDESampler(seed=0))

    def objective(trial: Trial) -> float:
        kind = trial.suggest_categorical("kind", ["a", "b"])
        x = trial.suggest_float("x", -5, 5)
        if kind == "a":
            return x * x + trial.suggest_float("only a", 0, 1)
        return x * x + trial.suggest_int("only b", 1, 3)

    study.optimize(objective, n_trials=100)
    assert all(t.state is TrialState.COMPLETE for t in study.trials)
    assert study.best_value < 0.3


# -- points 12 and 13: directions, constraints -----------------------------------------------------


def test_point_12_maximizing_is_minimizing_the_opposite(bench: Bench) -> None:
    runs = []
    directions: Any = ("minimize", "maximize")
    for direction, sign in zip(directions, (1.0, -1.0), strict=True):
        sampler = bench.sampler()
        study = optuna.create_study(direction=direction, sampler=sampler)

        def objective(trial: Trial, sampler: FIDESampler = sampler, sign: float = sign) -> float:
            image = bench.render(bench.suggest(trial))
            loss = float(np.square(image - bench.target).mean())
            return sampler.tell_image(trial, image, sign * loss)

        study.optimize(objective, n_trials=50)
        runs.append(bench.points(study))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_point_12_the_sampler_s_own_loss_is_not_to_be_maximized(bench: Bench) -> None:
    study = optuna.create_study(direction="maximize", sampler=bench.sampler())
    trial = study.ask()
    image = bench.render(bench.suggest(trial))
    with pytest.raises(ProtocolError, match="maximizes; give a loss"):
        bench.sampler_of(study).tell_image(trial, image)
    assert not study.trials[0].system_attrs.keys() & {"fide:image"}


def test_point_13_several_objectives_are_refused_where_all_parameters_are_enqueued(
    bench: Bench,
) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(directions=["minimize", "maximize"], sampler=sampler)
    study.enqueue_trial(dict(zip(bench.names, bench.answer.tolist(), strict=True)))
    trial = study.ask()
    image = bench.render(bench.suggest(trial))
    for loss in (None, 0.5):
        with pytest.raises(OptionError, match="cannot be used in a study of 2 objectives"):
            sampler.tell_image(trial, image, loss)
    assert "fide:image" not in study.trials[0].system_attrs


def test_point_13_constraints_are_used(bench: Bench) -> None:
    """The answer is forbidden: what is found violates nothing, and is the best of that."""
    study = optuna.create_study(sampler=bench.sampler())
    sampler = bench.sampler_of(study)

    def objective(trial: Trial) -> float:
        x = bench.suggest(trial)
        trial.set_constraint("left half", x[0] - 0.5)
        return sampler.tell_image(trial, bench.render(x))

    study.optimize(objective, n_trials=200)
    assert study.best_trial.params["x0"] <= 0.5
    last = [t for t in study.trials[-60:]]
    assert sum(t.params["x0"] <= 0.5 for t in last) > 30
    assert study.best_trial.params["x0"] > 0.42


def test_point_13_a_constraints_func_is_that_of_optuna_s_own_samplers(bench: Bench) -> None:
    """The same as constraints that the objective sets, to the bit."""
    runs = []
    for given in (True, False):
        function = (lambda trial: (trial.params["x0"] - 0.5,)) if given else None
        study = optuna.create_study(sampler=bench.sampler(constraints_func=function))
        sampler = bench.sampler_of(study)

        def objective(trial: Trial, given: bool = given, sampler: Any = sampler) -> float:
            x = bench.suggest(trial)
            if not given:
                trial.set_constraint("left half", x[0] - 0.5)
            return float(sampler.tell_image(trial, bench.render(x)))

        study.optimize(objective, n_trials=40)
        assert study.best_trial.params["x0"] <= 0.5
        runs.append(bench.points(study))
    np.testing.assert_array_equal(runs[0], runs[1])


# -- point 14: in other hands ----------------------------------------------------------------------


def test_point_14_under_hyperband(bench: Bench) -> None:
    study = optuna.create_study(
        sampler=bench.sampler(),
        pruner=optuna.pruners.HyperbandPruner(min_resource=1, max_resource=4),
    )
    sampler = bench.sampler_of(study)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        for step in range(4):
            trial.report(value + 0.1 / (step + 1), step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    study.optimize(objective, n_trials=60)
    complete = len(study.get_trials(states=(TrialState.COMPLETE,)))
    counts = counts_of(study)
    assert counts["left out"] == 60 - complete
    assert counts["member"] == complete == counts["image"]


def test_point_14_inside_partial_fixed(bench: Bench) -> None:
    sampler = bench.sampler()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        fixed = PartialFixedSampler({"x1": 0.35}, sampler)
    study = optuna.create_study(sampler=fixed)
    study.optimize(image_objective(lambda trial: bench.render(bench.suggest(trial))), n_trials=30)
    assert all(t.params["x1"] == 0.35 for t in study.trials)
    counts = sampler.counts(study)
    assert counts == {"injected": 1, "member": 29, "image": 30}


def test_point_14_the_independent_sampler_is_told(bench: Bench) -> None:
    calls: list[str] = []

    class Independent(RandomSampler):
        def before_trial(self, study: Any, trial: Any) -> None:
            calls.append("before")

        def after_trial(self, study: Any, trial: Any, state: Any, values: Any) -> None:
            calls.append("after")

        def reseed_rng(self) -> None:
            calls.append("reseed")

    sampler = bench.sampler(independent_sampler=Independent())
    study = optuna.create_study(sampler=sampler)
    bench.run(study, 2)
    sampler.reseed_rng()
    assert calls == ["before", "after", "before", "after", "reseed"]
