"""lq-CMA-ES: the library's own candidates, and what its model is for."""

from __future__ import annotations

from typing import Any

import cma
import numpy as np
import pytest

from fide_lab.baselines.evolution import CMA, LQCMA
from fide_plugins.types import Float64

from .global_state import recorded

DIM = 3


def valley(X: Float64) -> Float64:
    Y = 3.0 * X - 1.0
    value: Float64 = (10 * (Y[:, 1:] - Y[:, :-1] ** 2) ** 2 + (1 - Y[:, :-1]) ** 2).sum(axis=1)
    return value


def ellipsoid(X: Float64) -> Float64:
    value: Float64 = ((X - 0.3) ** 2 * 10.0 ** np.arange(X.shape[1])).sum(axis=1)
    return value


@pytest.mark.thorough
def test_it_is_the_library_to_the_last_bit_over_restarts() -> None:
    points, begun = recorded(cma.fmin_lq_surr2, valley, DIM, seed=5, evaluations=700)
    assert begun >= 2
    ours = LQCMA(DIM, sigma0=0.2, seed=5)
    for point in points:
        X = ours.ask()
        np.testing.assert_array_equal(X[0], np.clip(point, 0.0, 1.0))
        ours.tell(X, losses=valley(X))


def evaluations(opt: Any, goal: float) -> int:
    while opt.best is None or opt.best.loss > goal:
        X = opt.ask()
        opt.tell(X, losses=ellipsoid(X))
    return int(opt.evaluations)


def test_a_quadratic_loss_takes_a_fraction_of_the_evaluations() -> None:
    pairs = [
        (evaluations(LQCMA(5, seed=s), 1e-8), evaluations(CMA(5, seed=s), 1e-8)) for s in range(3)
    ]
    assert all(3 * model < plain for model, plain in pairs)


def test_the_population_is_the_librarys_own() -> None:
    with pytest.warns(RuntimeWarning, match="popsize=8 has no effect on lq-cma-es"):
        opt = LQCMA(3, seed=0, popsize=8)
    assert opt.popsize == len(opt.ask()) == 1
