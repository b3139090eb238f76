"""Dual annealing: SciPy's own points and results; and half of them denoised."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest
from scipy.optimize import dual_annealing

from fide_lab import optimizers
from fide_lab.baselines.base import Baseline
from fide_lab.baselines.image_based import FIDEAnnealing, Visits
from fide_lab.baselines.libraries import DualAnnealing
from fide_plugins.errors import OptionError, ProtocolError
from fide_plugins.types import Float64


def rastrigin(X: Float64) -> Float64:
    Y = 10.24 * (X - 0.43)
    value: Float64 = (10 + Y**2 - 10 * np.cos(2 * np.pi * Y)).sum(axis=1)
    return value


def scipys(dim: int, seed: int, **options: Any) -> tuple[Float64, Any]:
    points = []

    def function(x: Float64) -> float:
        points.append(x.copy())
        return float(rastrigin(x[None])[0])

    x0, rng = np.full(dim, 0.5), np.random.default_rng(seed)
    result = dual_annealing(function, [(0.0, 1.0)] * dim, x0=x0, rng=rng, **options)
    return np.array(points), result


@pytest.mark.parametrize("dim", [1, 4])
def test_it_is_scipy_to_the_last_bit(dim: int) -> None:
    points, result = scipys(dim, seed=11, maxfun=700)
    ours = DualAnnealing(dim, seed=11)
    for point in points:
        (x,) = ours.ask()
        np.testing.assert_array_equal(x, point)
        ours.tell(x[None], losses=rastrigin(x[None]))
    assert ours.evaluations == result.nfev  # the finite differences are among them
    losses = rastrigin(points)
    assert result.fun in losses  # and one of a finite difference may be below it
    assert ours.best is not None and ours.best.loss == losses.min()
    np.testing.assert_array_equal(ours.best.x, points[losses.argmin()])


def test_the_step_of_the_finite_differences_can_be_chosen() -> None:
    def points(**options: Any) -> Float64:
        opt = DualAnnealing(3, seed=2, **options)
        points = []
        for _ in range(1000):
            X = opt.ask()
            opt.tell(X, losses=rastrigin(X))
            points.append(X[0])
        return np.array(points)

    np.testing.assert_array_equal(points(step=1e-8), points())  # SciPy's own
    moved = np.abs(np.diff(points(step=0.01), axis=0))
    gradients = ((moved > 0).sum(axis=1) == 1) & np.isclose(moved.max(axis=1), 0.01)
    assert gradients.sum() > 20
    with pytest.raises(OptionError, match="step must be a positive number, not 0"):
        DualAnnealing(3, step=0)


def test_another_search_begins_where_scipy_returns() -> None:
    points, result = scipys(1, seed=3)
    ours = DualAnnealing(1, seed=3)
    for point in points:
        X = ours.ask()
        np.testing.assert_array_equal(X[0], point)
        ours.tell(X, losses=rastrigin(X))
    assert ours.starts == 1 and ours.evaluations == result.nfev
    assert 0 < ours.ask()[0, 0] < 1 and ours.starts == 2


def test_asked_for_more_it_gives_the_same_point_whose_other_results_are_not_used() -> None:
    one, several = DualAnnealing(2, seed=0), DualAnnealing(2, seed=0)
    for _ in range(30):
        X, Y = one.ask(), several.ask(3)
        np.testing.assert_array_equal(Y, np.repeat(X, 3, axis=0))
        one.tell(X, losses=rastrigin(X))
        several.tell(Y, losses=rastrigin(Y) + np.array([0.0, 5.0, 7.0]))
    assert several.evaluations == 3 * one.evaluations


def test_a_population_has_no_effect_and_one_warning() -> None:
    with pytest.warns(RuntimeWarning, match="popsize=12 has no effect on dual-annealing") as found:
        opt = DualAnnealing(2, seed=0, popsize=12)
        same = DualAnnealing(2, seed=0)
        for _ in range(30):
            X = opt.ask()
            assert X.shape == (1, 2)
            np.testing.assert_array_equal(X, same.ask())
            opt.tell(X, losses=rastrigin(X))
            same.tell(X, losses=rastrigin(X))
    assert len(found) == 1 and found[0].filename == __file__


def test_it_evaluates_one_point_at_a_time_until_it_is_closed() -> None:
    opt = DualAnnealing(2, seed=0)
    opt.tell(opt.ask(), losses=[1.0])
    opt.close()
    with pytest.raises(ProtocolError, match="was closed"):
        opt.ask()


# -- with FIDE's denoiser --------------------------------------------------------------------------


def picture(X: Float64) -> Float64:
    value: Float64 = np.repeat(X[:, :3], 16 * 16, axis=0).reshape(len(X), 16, 16, 3)
    return value


def run(opt: Baseline, evaluations: int) -> Float64:
    points = []
    while opt.evaluations < evaluations:
        X = opt.ask()
        opt.tell(X, picture(X), rastrigin(X))
        points.append(X)
    return np.concatenate(points)


def test_with_nothing_denoised_it_is_dual_annealing() -> None:
    target = picture(np.full((1, 3), 0.43))[0]
    plain = DualAnnealing(3, target, seed=5)
    ours = FIDEAnnealing(3, target, seed=5, samples=10**6)
    np.testing.assert_array_equal(run(ours, 400), run(plain, 400))
    plain = DualAnnealing(3, target, seed=5, step=0.01)
    ours = FIDEAnnealing(3, target, seed=5, samples=10**6, step=0.01)
    np.testing.assert_array_equal(run(ours, 200), run(plain, 200))


def test_scipy_goes_on_from_the_point_that_was_put_in_the_place_of_its_own() -> None:
    answer = np.array([0.43, 0.43, 0.43])  # so good that it is always accepted
    opt = FIDEAnnealing(3, picture(answer[None])[0], seed=1, samples=8, epochs=1)
    visits: Visits = opt._visits
    visits.denoise = lambda x, std: answer.copy()
    while visits.std is None:
        assert not visits.proposals
        opt.tell(*_one(opt))
    while not visits.proposals:
        opt.tell(*_one(opt))
    after = []
    for _ in range(200):
        X, images, losses = _one(opt)
        if not visits.descending:
            after.append(X[0])
        opt.tell(X, images, losses)
    proposed = [bool((x == answer).all()) for x in after]
    assert sum(proposed) >= len(after) // 2 - 1  # every second one
    one_changed = [int((x != answer).sum()) == 1 for x, p in zip(after, proposed, strict=True)]
    assert sum(one_changed) > 10  # SciPy's moves along one coordinate, from the answer


def _one(opt: FIDEAnnealing) -> tuple[Float64, Float64, Float64]:
    X = opt.ask()
    return X, picture(X), rastrigin(X)


def test_noise_and_training_follow_the_points_of_both_kinds() -> None:
    opt = FIDEAnnealing(3, picture(np.full((1, 3), 0.43))[0], seed=2, samples=20, epochs=1)
    trained: list[Float64] = []
    update = opt._proposer.update

    def observed(x: Float64, tokens: Any, losses: Any, std: Float64) -> Any:
        assert tokens.shape == (20, 1, 768)
        np.testing.assert_allclose(std, x.std(axis=0))
        trained.append(x)
        return update(x, tokens, losses, std)

    opt._proposer.update = observed  # type: ignore[assignment, method-assign]
    visited: deque[Float64] = deque()
    while len(trained) < 3:
        X, images, losses = _one(opt)
        if not opt._visits.descending:
            visited.append(X[0])
        opt.tell(X, images, losses)
    np.testing.assert_array_equal(np.concatenate(trained), np.array(visited)[:60])
    proposals = np.array(opt._visits.proposals)
    asked = np.array(visited)[20:60]
    among = [(p == asked).all(axis=1).any() for p in proposals[:20]]
    assert all(among)  # half of those after the first training


def test_names() -> None:
    assert isinstance(optimizers.make("dual-annealing", 2, seed=0), DualAnnealing)
