"""CMA-ES in three versions, and PGPE."""

from __future__ import annotations

import sys
from typing import Any

import cma
import numpy as np
import pytest

from fide_lab import baselines
from fide_lab.baselines.evolution import BIPOP, CMA, LQCMA, PGPE
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.types import Float64

from .global_state import recorded


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


@pytest.mark.thorough
@pytest.mark.parametrize("dim", [2, 5, 10])
def test_rosenbrock_is_solved(dim: int) -> None:
    """By most searches: from four dimensions on there is a second minimum."""
    solved = 0
    for seed in range(5):
        opt = CMA(dim, seed=seed)
        while opt.evaluations < 6000 and (opt.best is None or opt.best.loss > 1e-8):
            X = opt.ask()
            opt.tell(X, losses=rosenbrock(X))
        solved += opt.best is not None and opt.best.loss <= 1e-8
    assert solved >= 3


@pytest.mark.parametrize(("restarts", "sizes"), [("same", {10}), ("none", {10})])
def test_restarts_with_the_same_population(restarts: str, sizes: set[int]) -> None:
    opt = CMA(2, popsize=10, restarts=restarts, seed=0)
    while opt.evaluations < 3000:
        X = opt.ask()
        assert len(X) in sizes
        opt.tell(X, losses=((X - 0.4) ** 2).sum(axis=1))
    assert opt.starts == 1 if restarts == "none" else opt.starts >= 3
    assert opt.best is not None and opt.best.loss < 1e-12


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


def test_constant_losses_restart_without_complaint() -> None:
    opt = CMA(3, seed=0)
    for _ in range(200):
        X = opt.ask()
        opt.tell(X, losses=np.zeros(len(X)))
        assert X.min() >= 0.0 and X.max() <= 1.0
    assert opt.starts > 1


def test_a_restart_ignores_what_was_asked_before_it() -> None:
    opt = CMA(2, popsize=8, seed=0)
    late = opt.ask()
    while opt.starts == 1:
        X = opt.ask()
        opt.tell(X, losses=((X - 0.4) ** 2).sum(axis=1))
    mean = opt.recommend()
    opt.tell(late, losses=np.zeros(8))
    np.testing.assert_array_equal(opt.recommend(), mean)
    assert opt.best is not None and opt.best.loss == 0.0


def test_an_optimum_in_the_corner_of_the_box() -> None:
    opt = CMA(4, seed=0)
    while opt.evaluations < 1500:
        X = opt.ask()
        opt.tell(X, losses=X.sum(axis=1))
    assert opt.best is not None and opt.best.loss < 1e-6


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


@pytest.mark.parametrize("name", ["CMA", "BIPOP", "LQCMA"])
def test_without_the_package_it_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(DependencyError, match=r"pip install cma .*extra lab"):
        getattr(baselines, name)(3)


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


def valley(X: Float64) -> Float64:
    Y = 3.0 * X - 1.0
    value: Float64 = (10 * (Y[:, 1:] - Y[:, :-1] ** 2) ** 2 + (1 - Y[:, :-1]) ** 2).sum(axis=1)
    return value


def ellipsoid(X: Float64) -> Float64:
    value: Float64 = ((X - 0.3) ** 2 * 10.0 ** np.arange(X.shape[1])).sum(axis=1)
    return value


@pytest.mark.thorough
def test_the_model_of_losses_is_the_librarys_to_the_last_bit() -> None:
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


BOX = 4.0  # width of the box in the units of pgpelib
CENTERS = {  # of the distribution after so many generations
    1: [-0.07797400823950489, -0.041099368712359315, -0.058673302537083326, 0.10624659759212554],
    5: [-0.29441619657705, -0.4014124199253664, -0.005109274503082149, 0.4787556384289309],
    40: [0.9083097509120104, -1.022361445037495, -0.9018586572025242, 1.2581534370711125],
}
STDS = {
    1: [0.10106575726134442, 0.09998760126703127, 0.09942769039040518, 0.10089668276647065],
    5: [0.10269836120435093, 0.09881912491147972, 0.09973218529112672, 0.1018488794324596],
    40: [0.09158811843651282, 0.0816849448103819, 0.09828137201160916, 0.0904762738021507],
}


def objective(Y: Float64) -> Float64:
    """Losses (n,) of points (n, 4) in the units of pgpelib: a bowl with ripples."""
    bowl = (Y - [0.8, -1.2, 0.3, 2.0]) ** 2 @ [1.0, 4.0, 0.2, 1.0]
    losses: Float64 = bowl + np.cos(3 * Y).sum(axis=1)
    return losses


def test_center_and_standard_deviations_are_those_of_pgpelib() -> None:
    # pgpelib at its commit of 2020: PGPE(solution_length=4, popsize=6, optimizer="clipup",
    # optimizer_config={"max_speed": 0.15, "momentum": 0.9}, dtype="float64", seed=3)
    opt = PGPE(4, popsize=6, seed=0)
    opt._rng = np.random.RandomState(3)  # type: ignore[assignment]  # its generator
    for generation in range(1, 41):
        X = opt.ask()
        opt.tell(X, losses=objective((X - 0.5) * BOX))
        if generation in CENTERS:
            center, std = (opt.recommend() - 0.5) * BOX, opt._std * BOX
            np.testing.assert_allclose(center, CENTERS[generation], rtol=1e-9)
            np.testing.assert_allclose(std, STDS[generation], rtol=1e-9)


def test_samples_are_mirrored_about_the_center() -> None:
    opt = PGPE(3, popsize=8, seed=1)
    X = opt.ask()
    np.testing.assert_allclose(X[::2] + X[1::2], 1.0)


def test_the_center_never_moves_faster_than_its_bound_nor_leaves_the_box() -> None:
    opt = PGPE(2, popsize=10, seed=2, max_speed=0.02)
    before = opt.recommend()
    for _ in range(60):
        X = opt.ask()
        opt.tell(X, losses=X.sum(axis=1))  # to a corner of the box
        after = opt.recommend()
        assert np.linalg.norm(after - before) <= 0.02 + 1e-12
        assert (after >= 0).all()
        before = after
    assert before.max() < 0.05


def test_equal_losses_move_nothing_far() -> None:
    opt = PGPE(3, popsize=10, seed=0)
    X = opt.ask()
    opt.tell(X, losses=np.full(10, np.inf))
    assert np.isfinite(opt.recommend()).all() and (np.abs(opt.recommend() - 0.5) <= 0.0376).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"popsize": 7}, "popsize must be even"),
        ({"rate": 0}, "rate must be a positive number"),
        ({"max_speed": -1}, "max_speed must be a positive number"),
        ({"momentum": 2}, r"momentum must lie in \[0, 1\]"),
        ({"std_rate": 0}, "std_rate must be a positive number"),
    ],
)
def test_options_out_of_range(options: dict[str, float], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        PGPE(3, **options)
