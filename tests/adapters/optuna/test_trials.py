"""Trials that others made, and results that are none (acceptance points 9 and 10)."""

from __future__ import annotations

import numpy as np
import optuna
import pytest
from optuna.trial import Trial, TrialState

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


def test_point_9_a_copied_study_goes_on(bench: Bench) -> None:
    first, second = optuna.storages.InMemoryStorage(), optuna.storages.InMemoryStorage()
    study = optuna.create_study(study_name="a", storage=first, sampler=bench.sampler())
    bench.run(study, 30)
    optuna.copy_study(from_study_name="a", from_storage=first, to_storage=second)
    copied = optuna.load_study(study_name="a", storage=second, sampler=bench.sampler())
    bench.run(copied, 20)
    assert counts_of(copied)["image"] == 50  # the features came along
    assert counts_of(copied)["member"] + counts_of(copied)["altered"] == 50


def test_point_9_told_by_number_and_asked_with_distributions(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    for _ in range(20):
        trial = study.ask(fixed_distributions=bench.space)
        x = [trial.params[name] for name in bench.names]
        study.tell(trial.number, bench.sampler_of(study).tell_image(trial, bench.render(x)))
    assert counts_of(study) == {"member": 20, "image": 20}


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
