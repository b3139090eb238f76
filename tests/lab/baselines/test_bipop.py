"""BIPOP-CMA-ES: the library's own candidates, and every candidate evaluated once."""

from __future__ import annotations

import cma
import numpy as np

from fide_lab.baselines.evolution import BIPOP
from fide_plugins.types import Float64

from .global_state import recorded

DIM = 3


def rastrigin(X: Float64) -> Float64:
    Y = 8.0 * (X - 0.4)
    value: Float64 = (10 + Y**2 - 10 * np.cos(2 * np.pi * Y)).sum(axis=1)
    return value


def test_it_is_the_library_to_the_last_bit_over_restarts() -> None:
    points, begun = recorded(cma.fmin2, rastrigin, DIM, seed=5, evaluations=4000, bipop=True)
    assert begun >= 4
    ours = BIPOP(DIM, sigma0=0.2, seed=5)
    asked: list[Float64] = []
    sizes = set()
    while len(asked) < len(points):
        X = ours.ask()
        sizes.add(len(X))
        asked.extend(X)
        ours.tell(X, losses=rastrigin(X))
    np.testing.assert_array_equal(asked[: len(points)], np.clip(points, 0.0, 1.0))
    assert {
        1,
        7,
        14,
    } <= sizes  # the mean at the end, the first population, and its double, which is 14.6


def test_every_candidate_is_used_once_whoever_evaluates_it() -> None:
    calm, hasty = BIPOP(DIM, seed=1), BIPOP(DIM, seed=1)
    for _ in range(3):  # workers that take more than a generation get its candidates again
        X = calm.ask()
        Y = hasty.ask(2 * len(X))
        np.testing.assert_array_equal(Y, np.concatenate([X, X]))
        calm.tell(X, losses=rastrigin(X))
        twice = np.repeat(Y[: len(X)], 2, axis=0)  # each is told twice, before the next
        hasty.tell(twice, losses=np.where(np.arange(len(twice)) % 2, 1e9, rastrigin(twice)))
    np.testing.assert_array_equal(calm.ask(), hasty.ask())


def test_what_is_missing_of_a_generation_is_asked_again() -> None:
    opt = BIPOP(DIM, seed=1)
    X = opt.ask(2 * opt.popsize)[: opt.popsize]
    doubled = np.repeat(X[:-1], 2, axis=0)[: len(X)]  # so many results, but not of all
    opt.tell(doubled, losses=rastrigin(doubled))
    left = opt.ask()
    known = {x.tobytes() for x in doubled}
    np.testing.assert_array_equal(left, [x for x in X if x.tobytes() not in known])
