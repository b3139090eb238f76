"""Acceptance point 4 in full length: Nevergrad asks what FIDE asks by `ask(1)`, Optuna by `ask()`.

The two differ by the steps between the generations, of which `ask()` has none.
"""

from __future__ import annotations

import nevergrad as ng
import numpy as np
import optuna
import pytest

import fide_tasks
from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

RENDERS = 5000


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_point_4_nevergrad_asks_the_same_candidates_over_5000_renders(seed: int) -> None:
    """Eight Voronoi cells, asked one at a time; Nevergrad's scale rounds by 1e-9 at most."""
    task = fide_tasks.make("voronoi", size=32, seed=seed)
    alone = FIDE(task.dim, task.target, seed=seed)
    box = ng.p.Array(shape=(task.dim,), lower=0, upper=1)
    optimizer = ParametrizedFIDE(target=task.target, seed=seed)(box)
    for _ in range(RENDERS):
        X, candidate = alone.ask(1), optimizer.ask()
        np.testing.assert_allclose(candidate.value, X[0], rtol=0, atol=1e-9)
        image = task.render(X)[0]
        alone.tell(X, [image])
        optimizer.tell(candidate, image)
    assert alone.best is not None
    assert optimizer.recommend().loss == pytest.approx(alone.best.loss, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_point_4_optuna_asks_the_same_candidates_over_5000_renders(seed: int) -> None:
    """Eight Voronoi cells; the core asks whole generations, as a sampler does.

    (But for the first trial, of which Optuna learns the parameters one by one, and for what a
    product of several rows rounds differently.)
    """
    task = fide_tasks.make("voronoi", size=32, seed=seed)
    names = [f"x{i}" for i in range(task.dim)]
    alone, sampler = FIDE(task.dim, task.target, seed=seed), FIDESampler(task.target, seed=seed)
    study = optuna.create_study(sampler=sampler)
    while alone.evaluations < RENDERS:
        X = alone.ask()
        images = task.render(X)
        for x, image in zip(X, images, strict=True):
            trial = study.ask()
            suggested = [trial.suggest_float(name, 0, 1) for name in names]
            np.testing.assert_allclose(suggested, x, rtol=0, atol=1e-9)
            study.tell(trial, sampler.tell_image(trial, image))
        alone.tell(X, images)
    assert alone.best is not None
    assert study.best_value == pytest.approx(alone.best.loss, rel=1e-9)
    n = alone.evaluations
    assert sampler.counts(study) == {"member": n, "image": n}
