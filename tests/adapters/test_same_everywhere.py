"""Acceptance point 4 in full length: FIDE alone, in Nevergrad and in Optuna are one optimizer."""

from __future__ import annotations

import nevergrad as ng
import numpy as np
import optuna
import pytest

import fide_tasks
from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_point_4_the_same_candidates_and_the_same_best_over_5000_renders(seed: int) -> None:
    """Eight Voronoi cells; Nevergrad's scale rounds by 1e-9 at most, Optuna's unit box not at all.

    (But for the first trial, of which Optuna learns the parameters one by one.)
    """
    task = fide_tasks.make("voronoi", size=32, seed=seed)
    names = [f"x{i}" for i in range(task.dim)]
    alone = FIDE(task.dim, task.target, seed=seed)
    box = ng.p.Array(shape=(task.dim,), lower=0, upper=1)
    optimizer = ParametrizedFIDE(target=task.target, seed=seed)(box)
    sampler = FIDESampler(task.target, seed=seed)
    study = optuna.create_study(sampler=sampler)
    for number in range(5000):
        X = alone.ask(1)
        candidate, trial = optimizer.ask(), study.ask()
        suggested = [trial.suggest_float(name, 0, 1) for name in names]
        np.testing.assert_allclose(candidate.value, X[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(suggested, X[0], rtol=0, atol=0 if number else 1e-15)
        image = task.render(X)[0]
        alone.tell(X, [image])
        optimizer.tell(candidate, image)
        study.tell(trial, sampler.tell_image(trial, image))
    assert alone.best is not None
    assert optimizer.recommend().loss == pytest.approx(alone.best.loss, rel=1e-12)
    assert study.best_value == pytest.approx(alone.best.loss, rel=1e-12)
    assert sampler.counts(study) == {"member": 5000, "image": 5000}
