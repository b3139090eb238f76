"""Optimizers of Nevergrad and Optuna: their own points, by their own names."""

from __future__ import annotations

import sys
from typing import Any

import nevergrad
import numpy as np
import optuna
import pytest

from fide_lab import optimizers, run as harness
from fide_plugins.errors import DependencyError, OptimizerError, UnknownNameError
from fide_plugins.types import Float64

from .conftest import sphere


def points_of(name: str, evaluations: int, **options: Any) -> Float64:
    opt = optimizers.make(name, 3, seed=5, **options)
    points = []
    while opt.evaluations < evaluations:
        X = opt.ask()
        opt.tell(X, losses=sphere(X))
        points.append(X)
    return np.concatenate(points)


def test_nevergrads_points_are_its_own() -> None:
    array = nevergrad.p.Array(init=np.full(3, 0.5), lower=0.0, upper=1.0)
    bits = np.random.MT19937(np.random.SeedSequence(5))
    array.random_state = np.random.RandomState(bits)
    theirs = nevergrad.optimizers.registry["OnePlusOne"](array, budget=77, num_workers=1)
    for x in points_of("nevergrad:OnePlusOne", 60, budget=77):
        candidate = theirs.ask()
        np.testing.assert_array_equal(x, np.clip(candidate.value, 0.0, 1.0))
        theirs.tell(candidate, float(sphere(candidate.value[None])[0]))


def test_optunas_points_are_its_own_after_the_center() -> None:
    seed = int(np.random.SeedSequence(5).generate_state(1)[0])
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    study.enqueue_trial({f"x{i}": 0.5 for i in range(3)})
    X = points_of("optuna:TPESampler", 25)
    np.testing.assert_array_equal(X[0], np.full(3, 0.5))
    for x in X:
        trial = study.ask()
        theirs = [trial.suggest_float(f"x{i}", 0.0, 1.0) for i in range(3)]
        np.testing.assert_array_equal(x, theirs)
        study.tell(trial, float(sphere(np.array([theirs]))[0]))


def test_optuna_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    points_of("optuna:RandomSampler", 3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "known"), [("nevergrad:NGOptt", "NGOpt"), ("optuna:TPESample", "TPESampler")]
)
def test_unknown_names_are_named(name: str, known: str) -> None:
    with pytest.raises(UnknownNameError, match=f"did you mean '{known}"):
        optimizers.make(name, 2)


@pytest.mark.parametrize("name", ["nevergrad:", "pyswarm:PSO", "nevergrad"])
def test_unknown_families_are_named(name: str) -> None:
    with pytest.raises(UnknownNameError, match="nevergrad:NAME, .*optuna:NAME"):
        optimizers.make(name, 2)


@pytest.mark.parametrize("family", ["nevergrad", "optuna"])
def test_without_the_package_it_is_named(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [family, *(name for name in sys.modules if name.startswith(f"{family}."))]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DependencyError, match=f"pip install {family} .*extra {family}"):
        optimizers.make(f"{family}:Unheard", 2)


def test_a_run_tells_its_budget_to_those_that_plan() -> None:
    run = harness.prepare("voronoi", "nevergrad:NGOpt", budget=123, size=16)
    assert run.optimizer._library.budget == 123  # type: ignore[attr-defined]
    run = harness.prepare("voronoi", "nevergrad:NGOpt", budget=123, size=16, options={"budget": 9})
    assert run.optimizer._library.budget == 9  # type: ignore[attr-defined]


@pytest.mark.parametrize("step", ["ask", "tell", "provide_recommendation"])
def test_an_error_of_the_framework_is_said_to_be_its_own(
    step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt: Any = optimizers.make("nevergrad:OnePlusOne", 3, seed=5, budget=77)
    opt.tell(opt.ask(), losses=[1.0])

    def fails(*_: Any) -> Any:
        raise TypeError("only 0-dimensional arrays can be converted")

    monkeypatch.setattr(opt._library, step, fails)
    with pytest.raises(OptimizerError) as caught:
        opt.tell(opt.ask(), losses=[1.0])
        opt.recommend()
    said = str(caught.value)
    assert said.startswith("nevergrad:OnePlusOne failed after ") and "budget of 77" in said
    assert f"nevergrad {nevergrad.__version__}: TypeError: only 0-dimensional" in said
    assert said.endswith("use another optimizer than OnePlusOne, or another version of nevergrad")
    assert isinstance(caught.value.__cause__, TypeError)
