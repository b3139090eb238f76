"""Optuna and Nevergrad compare images as FIDE does."""

from __future__ import annotations

import nevergrad as ng
import numpy as np
import optuna
import pytest

from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

BACK = np.stack(np.broadcast_arrays(*np.mgrid[0:1:24j, 0:1:24j], 0.3), axis=-1).astype(np.float32)


def render(x: float, y: float) -> np.ndarray:
    image = BACK.copy()
    image[int(16 * y) :][:6, int(16 * x) :][:, :6] = [0.9, 0.1, 0.5]
    return image


TARGET = (0.7 * render(0.3, 0.6) + 0.1).astype(np.float32)


def expected(image: np.ndarray) -> float:
    optimizer = FIDE(2, TARGET, photometric="exposure", robust=0.2, seed=0)
    return float(optimizer.tell(np.full((1, 2), 0.5), image[None])[0])


def test_optuna() -> None:
    sampler = FIDESampler(target=TARGET, photometric="exposure", robust=0.2, seed=0)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial({"x": 0.3, "y": 0.6})

    def objective(trial: optuna.Trial) -> float:
        x, y = trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1)
        return sampler.tell_image(trial, render(x, y))

    study.optimize(objective, n_trials=12)
    assert study.best_value == pytest.approx(expected(render(0.3, 0.6)), abs=1e-9)
    assert study.best_value < 1e-4


def test_nevergrad() -> None:
    options = {"photometric": "exposure", "robust": 0.2}
    make = ParametrizedFIDE(target=TARGET, options=options)
    optimizer = make(ng.p.Array(shape=(2,), lower=0.0, upper=1.0), budget=12)
    candidate = optimizer.ask()
    image = render(*candidate.value)
    optimizer.tell(candidate, image)
    assert candidate.loss == pytest.approx(expected(image), rel=1e-6)
