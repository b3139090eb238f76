"""Trials that others made, and results that are none (acceptance points 9 and 10)."""

from __future__ import annotations

import numpy as np
import optuna
import pytest
from optuna.samplers import RandomSampler
from optuna.trial import Trial, TrialState

from fide_adapters.optuna import FIDESampler

from .conftest import Bench, asked_by_core, counts_of, state_of


def test_point_9_enqueued_whole_and_in_part(bench: Bench) -> None:
    answer = dict(zip(bench.names, bench.answer.tolist(), strict=True))
    with_it, without = 0.0, 0.0
    for seed in range(4):
        study = optuna.create_study(sampler=bench.sampler(search_space=bench.space, seed=seed))
        study.enqueue_trial(answer)
        study.enqueue_trial({"x0": 0.7})
        bench.run(study, 20)
        assert study.trials[0].params == answer and study.trials[1].params["x0"] == 0.7
        assert counts_of(study) == {"altered": 1, "member": 19, "image": 20}
        with_it += np.abs(bench.points(study)[10:] - bench.answer).mean()
        without += np.abs(asked_by_core(bench, 20, seed=seed)[10:] - bench.answer).mean()
    assert with_it < without  # what was enqueued is learned from: the search goes on around it


def test_a_study_that_another_sampler_began_is_not_searched_from_its_first_trial(
    bench: Bench,
) -> None:
    """An enqueued first trial counts like one that was added: the others may be better."""
    far = dict.fromkeys(bench.names, 0.05)
    asked = []
    for enqueued in (False, True):
        study = optuna.create_study(sampler=RandomSampler(seed=0))
        if enqueued:
            study.enqueue_trial(far)
            study.optimize(lambda trial: 0.5 + 0 * sum(bench.suggest(trial)), n_trials=1)
        else:
            study.add_trial(optuna.create_trial(params=far, distributions=bench.space, value=0.5))
        values = iter(np.linspace(0.4, 0.1, 8).tolist())
        for point in np.random.default_rng(0).random((8, 5)):
            params = dict(zip(bench.names, point.tolist(), strict=True))
            study.add_trial(
                optuna.create_trial(params=params, distributions=bench.space, value=next(values))
            )
        study.sampler = bench.sampler()
        bench.run(study, 8)
        asked.append(bench.points(study)[9:])
    np.testing.assert_array_equal(asked[0], asked[1])


def test_point_9_trials_are_added_before_during_and_after(bench: Bench) -> None:
    def add(study: optuna.Study) -> None:
        study.add_trial(
            optuna.create_trial(
                params=dict.fromkeys(bench.names, 0.5), distributions=bench.space, value=0.5
            )
        )

    study = optuna.create_study(sampler=bench.sampler())
    add(study)
    bench.run(study, 10)
    add(study)
    bench.run(study, 10)
    add(study)
    assert counts_of(study) == {"injected": 3, "member": 20, "image": 20}


def test_point_9_a_copied_study_goes_on(bench: Bench) -> None:
    first, second = optuna.storages.InMemoryStorage(), optuna.storages.InMemoryStorage()
    study = optuna.create_study(study_name="a", storage=first, sampler=bench.sampler())
    bench.run(study, 30)
    optuna.copy_study(from_study_name="a", from_storage=first, to_storage=second)
    copied = optuna.load_study(study_name="a", storage=second, sampler=bench.sampler())
    bench.run(copied, 20)
    assert counts_of(copied)["image"] == 50  # the features came along
    assert counts_of(copied)["member"] + counts_of(copied)["altered"] == 50


def test_point_9_a_study_that_another_sampler_began(bench: Bench) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    study.optimize(lambda t: float(np.sum(bench.suggest(t))), n_trials=20)
    study.sampler = bench.sampler()
    bench.run(study, 10)
    assert counts_of(study) == {"injected": 20, "member": 10, "image": 10}


def test_point_9_told_by_number_and_asked_with_distributions(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    for _ in range(20):
        trial = study.ask(fixed_distributions=bench.space)
        x = [trial.params[name] for name in bench.names]
        study.tell(trial.number, bench.sampler_of(study).tell_image(trial, bench.render(x)))
    assert counts_of(study) == {"member": 20, "image": 20}


@pytest.mark.parametrize("startup", [0, 5])
def test_point_9_startup_trials_are_drawn_independently(bench: Bench, startup: int) -> None:
    study = optuna.create_study(
        sampler=bench.sampler(search_space=bench.space, n_startup_trials=startup)
    )
    bench.run(study, 20)
    assert counts_of(study).get("injected", 0) == startup


# -- point 10: results that are none ---------------------------------------------------------------


@pytest.mark.parametrize("bad", ["fail", "pruned", "nan", "inf", "-inf", "huge", "constant"])
def test_point_10_any_result_is_survived(bench: Bench, bad: str) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = bench.sampler_of(study)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        if bad == "constant":
            return 0.25
        if trial.number % 3:
            return value
        if bad == "fail":
            raise ValueError("the renderer crashed")
        if bad == "pruned":
            trial.report(value, 1)
            raise optuna.TrialPruned
        return {"huge": 1e308}.get(bad, float(bad.replace("huge", "nan")))

    study.optimize(objective, n_trials=60, catch=ValueError)
    study.optimize(bench.objective(sampler), n_trials=50)
    X = bench.points(study)
    assert np.isfinite(X).all() and X.min() >= 0 and X.max() <= 1
    failed = sum(t.state is not TrialState.COMPLETE for t in study.trials)
    counts = counts_of(study)
    assert counts.get("left out", 0) == failed == (20 if bad in ("fail", "pruned", "nan") else 0)
    assert counts["member"] + counts.get("injected", 0) == 110 - failed
    assert not state_of(study).features


def test_point_10_the_features_of_a_failed_trial_are_released(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = bench.sampler_of(study)
    trial = study.ask()
    sampler.tell_image(trial, bench.render(bench.suggest(trial)))
    assert len(state_of(study).features) == 1
    study.tell(trial, state=TrialState.FAIL)
    assert not state_of(study).features


def test_point_10_pruned_trials_count_where_asked_for(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler(consider_pruned_trials=True))
    sampler = bench.sampler_of(study)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        trial.report(value, 0)
        if trial.number in (3, 4):
            raise optuna.TrialPruned
        return value

    study.optimize(objective, n_trials=20)
    assert counts_of(study) == {"member": 20, "image": 20}


def test_a_sampler_that_has_asked_nothing_counts_too(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 20)
    study.enqueue_trial(dict.fromkeys(bench.names, 0.5))
    bench.run(study, 1)
    newcomer: FIDESampler = bench.sampler()
    counts = newcomer.counts(study)
    assert counts["image"] == 21 and counts["injected"] == 1
    assert counts["member"] + counts.get("altered", 0) == 20
    assert newcomer.counts(optuna.create_study(sampler=newcomer)) == {}
