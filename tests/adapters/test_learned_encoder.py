"""The encoder of a learned model, by its name, in FIDE alone, in Nevergrad and in Optuna."""

from __future__ import annotations

from pathlib import Path

import nevergrad as ng
import numpy as np
import optuna
import pytest

from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE, learn
from fide_plugins.types import Float64

SIDE = 16


def render(x: Float64) -> Float64:
    """Gray ramp from x[0] to x[1]."""
    return np.repeat(np.linspace(x[0], x[1], SIDE)[None], SIDE, axis=0)


TARGET = render(np.array([0.2, 0.7]))


@pytest.fixture
def name(tmp_path: Path) -> str:
    """Name of the encoder of a model of `render`."""
    file = tmp_path / "model.fide"
    learn(render, 2, renders=100, size=SIDE, passes=1, out=file)
    return f"learned:{file}"


def test_nevergrad_asks_what_fide_alone_asks(name: str, tmp_path: Path) -> None:
    alone = FIDE(2, TARGET, encoder=name, seed=0, popsize=6)
    box = ng.p.Array(shape=(2,), lower=0, upper=1)
    optimizer = ParametrizedFIDE(target=TARGET, encoder=name, seed=0, popsize=6)(box)
    for _ in range(40):
        (x,), candidate = alone.ask(1), optimizer.ask()
        np.testing.assert_allclose(candidate.value, x, rtol=0, atol=1e-9)
        alone.tell(x[None], [render(x)])
        optimizer.tell(candidate, render(x))
    optimizer.dump(tmp_path / "dump")
    again = ng.optimizers.base.Optimizer.load(tmp_path / "dump")
    np.testing.assert_array_equal(again.ask().value, optimizer.ask().value)


def test_optuna_stores_its_features(name: str) -> None:
    sampler = FIDESampler(TARGET, encoder=name, seed=0, popsize=6)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: optuna.Trial) -> float:
        x = np.array([trial.suggest_float(axis, 0, 1) for axis in ("left", "right")])
        return sampler.tell_image(trial, render(x))

    study.optimize(objective, n_trials=40)
    assert sampler.counts(study) == {"member": 40, "image": 40}
    assert study.best_value < 1e-3
