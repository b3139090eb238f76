"""A study that goes on with another target or loss: losses of another problem do not count."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
import torch
from optuna.samplers import RandomSampler
from PIL import Image

from fide_adapters.optuna import FIDESampler, image_objective
from fide_adapters.optuna.storage import ASK, IMAGE

from .conftest import Bench, counts_of

ELSEWHERE = [0.2, 0.8, 0.3, 0.9, 0.6]
HALF = np.repeat([[0.0, 1.0]], 8, axis=0).repeat(4, axis=1)
OTHER: dict[str, Callable[[Bench], dict[str, Any]]] = {
    "target": lambda bench: {"target": bench.render(ELSEWHERE)},
    "loss": lambda bench: {"loss": "perceptual"},
    "mask": lambda bench: {"mask": HALF},
    "views": lambda bench: {"target": [bench.target]},
}


def goes_on(study: optuna.Study, sampler: FIDESampler) -> optuna.Study:
    """The same study with another sampler, as a later process loads it."""
    return optuna.load_study(study_name=study.study_name, storage=study._storage, sampler=sampler)


def problems_of(study: optuna.Study) -> list[Any]:
    """What the records of each trial say."""
    found = [t.system_attrs[IMAGE]["t"] for t in study.trials]
    for trial, problem in zip(study.trials, found, strict=True):
        assert trial.system_attrs.get(ASK, {"t": problem})["t"] == problem
    return found


@pytest.mark.parametrize("what", OTHER)
def test_losses_of_another_problem_are_left_out_with_one_warning(bench: Bench, what: str) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 30)
    later = goes_on(study, bench.sampler(**OTHER[what](bench)))
    listed = what == "views"

    def draw(trial: optuna.Trial) -> Any:
        image = bench.render(bench.suggest(trial))
        return [image] if listed else image

    with pytest.warns(RuntimeWarning, match="trials 0-29 were scored against another") as caught:
        later.optimize(image_objective(draw), n_trials=20)
    assert len(caught) == 1 and "start a new study" in str(caught[0].message)
    assert counts_of(later) == {"left out": 30, "member": 20, "image": 20}
    assert len(set(problems_of(later)[:30])) == len(set(problems_of(later)[30:])) == 1


@pytest.mark.parametrize("seed", range(3))
def test_another_target_is_found_as_in_a_new_study(bench: Bench, seed: int) -> None:
    target = bench.render(ELSEWHERE)
    study = optuna.create_study(sampler=bench.sampler(seed=seed))
    bench.run(study, 100)
    later = goes_on(study, bench.sampler(seed=seed, target=target))
    with pytest.warns(RuntimeWarning, match="another target"):
        bench.run(later, 100)
    new = optuna.create_study(sampler=bench.sampler(seed=seed, target=target))
    bench.run(new, 100)
    found = min(trial.value for trial in later.trials[100:] if trial.value is not None)
    assert found < 100 * new.best_value and found < 1e-3


def test_workers_with_two_targets_do_not_disturb_each_other(bench: Bench) -> None:
    """Also not by what their records say of when a search began."""
    first = optuna.create_study(sampler=bench.sampler(patience=2, search_space=bench.space))
    target = bench.render(ELSEWHERE)
    second = goes_on(first, bench.sampler(target=target, patience=2, search_space=bench.space))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(40):
            bench.run(first, 2)
            bench.run(second, 2)
        for study in (first, second):
            assert counts_of(study) == {"left out": 80, "member": 80, "image": 80}


def test_records_of_earlier_versions_count_as_they_did(bench: Bench) -> None:
    """They do not say which target and loss they are of."""
    study = optuna.create_study(sampler=bench.sampler(patience=2))
    bench.run(study, 40)
    asked = []
    for forget in (False, True):
        trials = study.get_trials()
        for trial in trials:
            for record in trial.system_attrs.values() if forget else ():
                record.pop("t", None)
        later = optuna.create_study(sampler=bench.sampler(patience=2))
        later.add_trials(trials)
        bench.run(later, 40)
        asked.append(bench.points(later))
        assert counts_of(later)["image"] == 80 and "left out" not in counts_of(later)
    np.testing.assert_array_equal(asked[0], asked[1])


def test_trials_of_other_hands_count_for_every_target(bench: Bench) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    study.optimize(lambda trial: sum(bench.suggest(trial)), n_trials=5)
    later = goes_on(study, bench.sampler())
    later.enqueue_trial(dict.fromkeys(bench.names, 0.5))
    bench.run(later, 5)
    assert counts_of(later) == {"injected": 6, "member": 4, "image": 5}


def test_own_losses_are_taken_for_the_same(bench: Bench) -> None:
    def one(images: Any) -> Any:
        return np.abs(np.asarray(images) - bench.target).mean(axis=(1, 2, 3))

    def two(images: Any) -> Any:
        return 2 * one(images)

    study = optuna.create_study(sampler=bench.sampler(loss=one))
    bench.run(study, 10)
    later = goes_on(study, bench.sampler(loss=two))
    bench.run(later, 10)
    assert counts_of(later)["image"] == 20


def test_the_record_is_of_the_target_as_it_is_read(bench: Bench, tmp_path: Path) -> None:
    """However it is given, and on whatever machine: the digest is written out."""
    pixels = (np.arange(8 * 8 * 3) % 251).astype(np.uint8).reshape(8, 8, 3)
    picture = Image.fromarray(pixels)
    picture.save(tmp_path / "target.png")
    tensor = torch.from_numpy(pixels.astype(np.float32) / np.float32(255)).permute(2, 0, 1)
    given = [pixels, picture, tmp_path / "target.png", tensor]
    for target in given:
        study = optuna.create_study(sampler=bench.sampler(target=target))
        bench.run(study, 1)
        assert problems_of(study) == ["DF9F"]


def test_a_trial_counts_for_who_asks_and_for_who_tells(bench: Bench) -> None:
    """The first one was asked before its parameters were known, so nothing says by whom."""
    asking, telling = bench.sampler(), bench.sampler(loss="perceptual")
    study = optuna.create_study(sampler=asking)
    with pytest.warns(RuntimeWarning, match="trial 0 was scored against another target"):
        study.optimize(lambda t: telling.tell_image(t, bench.render(bench.suggest(t))), n_trials=8)
    assert counts_of(study)["left out"] == 1
    assert counts_of(goes_on(study, telling))["image"] == 8


@pytest.mark.parametrize("problem", [3, ["x"], {}, True])
def test_a_problem_that_is_no_digest(bench: Bench, problem: Any) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 5)
    trials = study.get_trials()
    for trial in trials:
        for record in trial.system_attrs.values():
            record["t"] = problem
    later = optuna.create_study(sampler=bench.sampler())
    later.add_trials(trials)
    with pytest.warns(RuntimeWarning, match="fide:ask"):
        bench.run(later, 5)
    assert counts_of(later)["image"] == 10
