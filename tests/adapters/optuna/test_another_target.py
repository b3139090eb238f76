"""A study that goes on with another target or loss: losses of another problem do not count."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import optuna
import pytest

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
    found = [t.system_attrs[IMAGE]["problem"] for t in study.trials]
    for trial, problem in zip(study.trials, found, strict=True):
        assert trial.system_attrs.get(ASK, {"problem": problem})["problem"] == problem
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

    with pytest.warns(RuntimeWarning, match="trial 0 was scored against another") as caught:
        later.optimize(image_objective(draw), n_trials=20)
    assert len(caught) == 1 and "start a new study" in str(caught[0].message)
    assert counts_of(later) == {"left out": 30, "member": 20, "image": 20}
    assert len(set(problems_of(later)[:30])) == len(set(problems_of(later)[30:])) == 1


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
