"""Hard to search: corners, parameters that do nothing or the same, all candidates in one point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.search.cma_es import CMAES
from fide_plugins.types import Float32, Float64

DIM, SIZE = 4, 6
WEIGHTS = np.random.default_rng(3).standard_normal((DIM, SIZE * SIZE * 3))
Render = Callable[[Float64], Float32]


def render(X: Float64) -> Float32:
    """Images (n, 6, 6, 3) of four parameters."""
    images: Float32 = (1 / (1 + np.exp((0.5 - X) @ WEIGHTS))).astype(np.float32)
    return images.reshape(len(X), SIZE, SIZE, 3)


def fit(dim: int, answer: Float64, draw: Render, budget: int) -> FIDE:
    opt = FIDE(dim, draw(answer[None])[0], seed=0)
    while opt.evaluations < budget:
        X = opt.ask()
        opt.tell(X, draw(X))
    return opt


@pytest.mark.parametrize("answer", [np.zeros(DIM), np.ones(DIM), np.array([0.0, 1.0, 0.0, 1.0])])
def test_an_answer_in_a_corner(answer: Float64) -> None:
    opt = fit(DIM, answer, render, 500)
    assert opt.best is not None and opt.best.loss < 1e-7
    np.testing.assert_allclose(opt.best.x, answer, atol=2e-3)


def test_a_population_in_one_point_moves_on() -> None:
    """Told thirty times that all were in one point; then a minimum elsewhere is found."""
    search, rng = CMAES(np.full(DIM, 0.5), 1 / 6, 8), np.random.default_rng(0)
    for _ in range(30):
        search.tell(np.full((8, DIM), 0.5), np.zeros(8), np.zeros(8, bool))
    assert 0 < search.std.max() < 1e-2  # collapsed
    for _ in range(400):
        z = search.sample(8, rng)
        search.tell(z, np.square(z - 0.8).sum(axis=1), np.zeros(8, bool))
    np.testing.assert_allclose(search.mean, 0.8, atol=1e-6)


def test_a_search_that_collapsed_beside_the_answer_finds_it_in_the_next() -> None:
    """It begins with a millionth of the usual width, where all images are one."""
    answer = np.full(DIM, 0.9)
    opt = FIDE(DIM, render(answer[None])[0], seed=0, x0=np.full(DIM, 0.1), sigma0=1e-6)
    while opt.evaluations < 1500:
        X = opt.ask()
        opt.tell(X, render(X))
    assert opt.best is not None and opt.best.loss < 1e-6
