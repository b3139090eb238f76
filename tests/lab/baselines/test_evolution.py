"""CMA-ES of the library `cma`, and diffusion evolution."""

from __future__ import annotations

import sys

import cma
import numpy as np
import pytest

from fide_lab.baselines.evolution import CMA, DiffusionEvolution
from fide_plugins.errors import DependencyError
from fide_plugins.types import Float64


def rosenbrock(X: Float64) -> Float64:
    Y = 4.0 * X - 2.0
    value: Float64 = (100 * (Y[:, 1:] - Y[:, :-1] ** 2) ** 2 + (1 - Y[:, :-1]) ** 2).sum(axis=1)
    return value


def test_it_is_the_library_to_the_last_bit() -> None:
    rng = np.random.default_rng(11)
    reference = cma.CMAEvolutionStrategy(
        np.full(6, 0.5),
        0.2,
        {
            "bounds": [0, 1],
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": np.nan,
            "verbose": -9,
            "popsize": 12,
        },
    )
    ours = CMA(6, popsize=12, sigma0=0.2, seed=11)
    for _ in range(60):
        X, Y = ours.ask(), np.array(reference.ask())
        np.testing.assert_array_equal(X, Y)
        ours.tell(X, losses=rosenbrock(X))
        reference.tell(list(Y), rosenbrock(Y).tolist())
    np.testing.assert_array_equal(ours.recommend(), reference.result.xfavorite)


@pytest.mark.parametrize("largest", [1e308, np.finfo(float).max, -3.0])
def test_the_library_gets_finite_losses_with_the_same_ranking(
    largest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[list[float]] = []
    opt = CMA(2, popsize=4)
    monkeypatch.setattr(opt._es, "tell", lambda X, losses: told.append(losses))
    opt.tell(opt.ask(), losses=[-5.0, largest, np.nan, np.inf])
    (losses,) = told
    assert losses[:2] == [-5.0, largest] and np.isfinite(losses).all()
    assert losses[2] == losses[3] >= largest


@pytest.mark.parametrize(("restarts", "sizes"), [("same", {10}), ("none", {10})])
def test_restarts_with_the_same_population(restarts: str, sizes: set[int]) -> None:
    opt = CMA(2, popsize=10, restarts=restarts, seed=0)
    while opt.evaluations < 3000:
        X = opt.ask()
        assert len(X) in sizes
        opt.tell(X, losses=((X - 0.4) ** 2).sum(axis=1))
    assert opt.starts == 1 if restarts == "none" else opt.starts >= 3
    assert opt.best is not None and opt.best.loss < 1e-12


def test_bipop_spends_as_much_on_small_populations() -> None:
    opt = CMA(2, popsize=6, restarts="bipop", seed=0)
    spent: dict[int, int] = {}
    while opt.evaluations < 6000:
        X = opt.ask()
        spent[len(X)] = spent.get(len(X), 0) + len(X)
        opt.tell(X, losses=((X - 0.4) ** 2).sum(axis=1))
    large = [6 * 2**i for i in range(1, 9)]
    assert set(large[:2]) <= set(spent) and len(set(spent) - set(large)) >= 2
    assert 0.3 < sum(n for size, n in spent.items() if size in large) / opt.evaluations < 0.8


def test_a_population_diffuses_to_the_fittest() -> None:
    opt = DiffusionEvolution(2, popsize=32, budget=1600, seed=0)
    spreads, losses = [], []
    while opt.evaluations < 1600:
        X = opt.ask()
        spreads.append(float(X.std(axis=0).max()))
        losses.append(((X - 0.4) ** 2).sum(axis=1))
        opt.tell(X, losses=losses[-1])
    assert spreads[0] > 0.1 and spreads[-1] < 0.02
    assert np.median(losses[-1]) < 0.01 * np.median(losses[0])
    assert opt.ask().std(axis=0).max() > 0.1  # it begins again


def test_ipop_doubles_the_population() -> None:
    opt = CMA(2, popsize=6, restarts="ipop", seed=0)
    sizes = []
    while opt.evaluations < 3000:
        X = opt.ask()
        sizes.append(len(X))
        opt.tell(X, losses=((X - 0.4) ** 2).sum(axis=1))
    asked = list(dict.fromkeys(sizes))
    assert len(asked) >= max(4, opt.starts - 1)  # the last one may not have been asked yet
    assert asked == [6 * 2**i for i in range(len(asked))]
    assert opt.starts >= 3


def test_the_recommendation_is_of_the_search_that_found_the_best() -> None:
    """Two basins: most searches end in the worse one, and the last is seldom the best."""

    def basins(X: Float64) -> Float64:
        near, far = ((X - 0.15) ** 2).sum(axis=1), ((X - 0.8) ** 2).sum(axis=1)
        losses: Float64 = np.minimum(50 * near, 0.05 + far)
        return losses

    opt = CMA(2, popsize=6, sigma0=0.1, seed=0)
    while opt.starts < 12 or opt.best is None or (opt.best.loss > 1e-9 and opt.starts < 100):
        X = opt.ask()
        opt.tell(X, losses=basins(X))
    assert opt.best is not None and opt.best.loss < 1e-9
    np.testing.assert_allclose(opt.recommend(), 0.15, atol=1e-3)


def test_without_the_package_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(DependencyError, match=r"pip install cma .*extra lab"):
        CMA(3)
