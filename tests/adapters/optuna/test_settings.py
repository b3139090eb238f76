"""Settings that are not valid, and what a user is warned of."""

from __future__ import annotations

from typing import Any

import numpy as np
import optuna
import pytest
from optuna.distributions import FloatDistribution

from fide_adapters.optuna import FIDESampler
from fide_plugins.errors import ImageError, LossError, OptionError, ProtocolError

from .conftest import Bench, counts_of

WRONG: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "no image": ({"target": np.zeros((8, 8, 2))}, ImageError, "channels"),
    "preset": ({"preset": "best"}, OptionError, "preset"),
    "option": ({"colour": 3}, OptionError, "colour"),
    "constraints_func": ({"constraints_func": 3}, OptionError, "is a function of a trial"),
    "popsize": ({"popsize": 1}, OptionError, "popsize"),
    "sigma0": ({"sigma0": 0}, OptionError, "sigma0"),
    "seed": ({"seed": -1}, OptionError, "seed"),
    "loss": ({"loss": "nice"}, OptionError, "nice"),
    "encoder": ({"encoder": "eye"}, OptionError, "eye"),
    "search space": ({"search_space": ["x"]}, OptionError, "search_space"),
    "search space of numbers": ({"search_space": {"x": (0, 1)}}, OptionError, "FloatDistribution"),
    "empty search space": ({"search_space": {}}, OptionError, "leave it out"),
    "independent sampler": ({"independent_sampler": 3}, OptionError, "independent_sampler"),
    "loss without target": ({"target": None, "loss": "mse"}, OptionError, "target"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_settings(bench: Bench, what: str) -> None:
    settings, error, message = WRONG[what]
    with pytest.raises(error, match=message) as caught:
        bench.sampler(**settings)
    assert isinstance(caught.value, ValueError)


def test_without_a_target_what_is_told_is_checked(bench: Bench) -> None:
    sampler = FIDESampler()
    trial = optuna.create_study(sampler=sampler).ask()
    with pytest.raises(ProtocolError, match="target="):
        sampler.tell_image(trial, bench.target)
    with pytest.raises(LossError, match="loss"):
        sampler.tell_image(trial, bench.target, "low")  # type: ignore[arg-type]
    with pytest.raises(ProtocolError, match="type int; give that trial"):
        sampler.tell_image(0, bench.target, 1.0)


def test_no_image_is_refused_with_what_to_do(bench: Bench) -> None:
    sampler = bench.sampler()
    trial = optuna.create_study(sampler=sampler).ask()
    for loss in (None, 1.0):
        with pytest.raises(ImageError, match="not None; without one return the loss.*TrialPruned"):
            sampler.tell_image(trial, None, loss)


def test_a_search_space_that_promises_too_much_is_warned_of_once(bench: Bench) -> None:
    space = {**bench.space, "never": FloatDistribution(0.0, 1.0)}
    study = optuna.create_study(sampler=bench.sampler(search_space=space))
    with pytest.warns(
        RuntimeWarning, match="has 'never' as Float.*suggests it not at all.*make them equal"
    ) as caught:
        bench.run(study, 5)
    assert len(caught) == 1
    assert counts_of(study) == {"left out": 5}


@pytest.mark.filterwarnings("ignore:Choices for a categorical distribution should be")
def test_choices_of_a_study_in_memory_may_be_anything() -> None:
    functions: Any = [np.sin, np.cos]

    def objective(trial: optuna.Trial) -> float:
        function: Any = trial.suggest_categorical("f", functions)
        power = trial.suggest_categorical("n", list(np.arange(1, 4)))
        return float(function(trial.suggest_float("x", 0, 1)) ** power)

    study = optuna.create_study(sampler=FIDESampler(seed=0))
    study.optimize(objective, n_trials=30)
    assert counts_of(study)["member"] > 10
