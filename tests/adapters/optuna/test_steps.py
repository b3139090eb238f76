"""Gauss-Newton steps of a worker that knows all results."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import optuna
import pytest

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.storage import read_ask

from .conftest import Bench, counts_of, state_of


def stepping(bench: Bench, **settings: Any) -> FIDESampler:
    return bench.sampler(proposer="both", search_space=bench.space, **settings)


def test_one_worker_takes_steps_and_gains_by_them(bench: Bench) -> None:
    losses = []
    for sampler in (bench.sampler(search_space=bench.space), stepping(bench)):
        study = optuna.create_study(sampler=sampler)
        bench.run(study, 60)
        losses.append(study.best_value)
    assert losses[1] < losses[0] / 10
    counts = counts_of(study)
    assert counts["step"] > 10 and counts["member"] + counts["step"] == counts["image"] == 60


@pytest.mark.parametrize("done", [15, 40])
def test_a_pickled_sampler_goes_on_as_if_nothing_had_happened(bench: Bench, done: int) -> None:
    whole = optuna.create_study(sampler=stepping(bench))
    bench.run(whole, 60)
    part = optuna.create_study(sampler=stepping(bench))
    bench.run(part, done)
    part.sampler = pickle.loads(pickle.dumps(part.sampler))
    bench.run(part, 60 - done)
    np.testing.assert_array_equal(bench.points(part), bench.points(whole))


def test_a_worker_that_reads_the_study_knows_the_same_generation(bench: Bench) -> None:
    study = optuna.create_study(sampler=stepping(bench))
    bench.run(study, 40)
    later = optuna.load_study(
        study_name=study.study_name, storage=study._storage, sampler=stepping(bench)
    )
    assert sum(counts_of(later).values()) == sum(counts_of(study).values())
    assert counts_of(later)["step"] == counts_of(study)["step"]
    both = [state_of(one).optimizer for one in (study, later)]
    assert both[0].at == both[1].at == 40
    assert both[0].replica.generation == both[1].replica.generation
    bench.run(later, 20)
    assert later.best_value < float(study.trials[0].value or 0.0) / 100


def test_who_asks_beside_others_gets_no_step(bench: Bench) -> None:
    study = optuna.create_study(sampler=stepping(bench))
    sampler = bench.sampler_of(study)
    for _ in range(20):
        trials = [study.ask(bench.space) for _ in range(3)]
        for trial in trials:
            image = bench.render(bench.suggest(trial))
            study.tell(trial, sampler.tell_image(trial, image))
    counts = counts_of(study)
    assert 0 < counts["step"] <= 20  # one of three: the first
    assert counts["image"] == 60


@pytest.mark.parametrize("error", [RuntimeError, optuna.TrialPruned])
def test_after_a_step_that_fails_or_is_pruned_comes_a_generation(
    bench: Bench, error: type[Exception]
) -> None:
    study = optuna.create_study(sampler=stepping(bench))
    sampler = bench.sampler_of(study)

    def objective(trial: optuna.Trial) -> float:
        x = bench.suggest(trial)
        ask = read_ask(study.trials[trial.number])
        if ask is not None and ask.step:
            raise error
        return sampler.tell_image(trial, bench.render(x))

    study.optimize(objective, n_trials=90, catch=(RuntimeError,))
    asks = [read_ask(trial) for trial in study.trials]
    failed = [ask.generation for ask in asks if ask is not None and ask.step]
    assert len(failed) == len(set(failed)) > 5
    assert sampler.counts(study)["left out"] == len(failed)


def test_workers_that_ask_while_a_step_is_out_agree(bench: Bench) -> None:
    """Some have drawn the generation before they know the result of the step, and some after."""
    first = optuna.create_study(sampler=stepping(bench))
    name, storage = first.study_name, first._storage
    studies = [first]
    for _ in range(2):
        sampler = stepping(bench)
        studies.append(optuna.load_study(study_name=name, storage=storage, sampler=sampler))
    rng = np.random.default_rng(0)
    running: list[tuple[optuna.Study, optuna.Trial]] = []
    while len(first.trials) < 100 or running:
        if len(running) < rng.integers(1, 4) and len(first.trials) < 100:
            study = studies[rng.integers(3)]
            running.append((study, study.ask(bench.space)))
        elif running:
            study, trial = running.pop(int(rng.integers(len(running))))
            image = bench.render(bench.suggest(trial))
            study.tell(trial, bench.sampler_of(study).tell_image(trial, image))
    counts = [counts_of(study) for study in studies]
    assert counts[0] == counts[1] == counts[2]
    assert counts[0]["step"] > 0 and "altered" not in counts[0]
