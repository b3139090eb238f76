"""Libraries that call a function, SciPy, DFO-LS, Nevergrad and Optuna."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import dfols
import nevergrad
import numpy as np
import optuna
import pytest
from scipy.optimize import dual_annealing

from fide_lab import optimizers
from fide_lab.baselines.base import Baseline
from fide_lab.baselines.image_based import FIDEAnnealing, Visits
from fide_lab.baselines.libraries import DFOLS, DualAnnealing, ReverseCommunication
from fide_plugins import encoders
from fide_plugins.errors import (
    DependencyError,
    OptimizerError,
    OptionError,
    UnknownNameError,
)
from fide_plugins.types import Float32, Float64

from .conftest import sphere


def count(function: Callable[[Any], Any]) -> None:
    """Evaluate 0, then the sums of all values so far, three in all."""
    total = np.zeros(1)
    for _ in range(3):
        total = total + function(total)


def test_points_and_values_go_to_and_fro() -> None:
    caller = ReverseCommunication(count)
    seen = []
    while (point := caller.point()) is not None:
        seen.append(float(point[0]))
        caller.answer(2.0 + len(seen))
    assert seen == [0.0, 3.0, 7.0]
    assert caller.over and caller.point() is None


def test_an_error_of_the_library_reaches_the_user() -> None:
    def search(function: Callable[[Any], Any]) -> None:
        function(np.zeros(1))
        raise ZeroDivisionError("in the library")

    caller = ReverseCommunication(search)
    caller.point()
    with pytest.raises(ZeroDivisionError, match="in the library"):
        caller.answer(1.0)
    assert caller.over


def test_a_search_that_is_forgotten_is_cancelled_and_cleans_up() -> None:
    left = []

    def search(function: Callable[[Any], Any]) -> None:
        try:
            while True:
                function(np.zeros(1))
        except Exception:  # a library may catch all errors, and yet is to end
            left.append("caught")
        finally:
            left.append("left")

    before = threading.active_count()
    caller: ReverseCommunication | None = ReverseCommunication(search)
    assert caller is not None and caller.point() is not None
    assert threading.active_count() == before + 1
    caller = None
    assert threading.active_count() == before and left == ["left"]


def test_after_ctrl_c_it_waits_for_the_same_point() -> None:
    class Interrupted:
        def get(self) -> Any:
            caller._points = points
            raise KeyboardInterrupt

    caller: Any = ReverseCommunication(count)
    points, caller._points = caller._points, Interrupted()
    with pytest.raises(KeyboardInterrupt):
        caller.point()
    assert caller.point() == 0.0


def test_python_exits_while_a_search_waits() -> None:
    program = (
        "from fide_lab.baselines.libraries import ReverseCommunication\n"
        "caller = ReverseCommunication(lambda function: [function([0.0]) for _ in range(9)])\n"
        "print(caller.point())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert (done.stdout, done.stderr) == ("[0.]\n", "")


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
        assert not opt._visits.made
        opt.tell(*_one(opt))
    while not opt._visits.made:
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
    proposals = np.array(opt._visits.made)
    asked = np.array(visited)[20:60]
    among = [(p == asked).all(axis=1).any() for p in proposals[:20]]
    assert all(among)  # half of those after the first training


DIM = 4


def smooth(X: Float64) -> Float32:
    """Images (n, 16, 16, 3) that change smoothly, and not linearly, with the parameters."""
    waves = np.random.default_rng(3).random((DIM, 16 * 16 * 3))
    images: Float32 = (0.5 + 0.4 * np.sin(X @ waves)).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


TARGET = smooth(np.array([[0.3, 0.6, 0.4, 0.7]]))[0]


def residuals(x: Float64) -> Float64:
    encode = encoders.make("dense")
    seen, wanted = (encode(images)[0, :, :3].numpy() for images in (smooth(x[None]), TARGET[None]))
    difference = (seen.astype(np.float64) - wanted).ravel()
    scaled: Float64 = difference / np.sqrt(len(difference))
    return scaled


def test_it_is_the_solver_itself_to_the_last_bit() -> None:
    points = []

    def function(x: Float64) -> Float64:
        points.append(x.copy())
        return residuals(x)

    x0 = np.clip(0.5 + 1 / 6 * np.random.default_rng(7).standard_normal(DIM), 0.0, 1.0)
    users: Any = np.random.get_state()
    np.random.set_state(
        np.random.RandomState(np.random.MT19937(np.random.SeedSequence(7))).get_state()
    )
    try:
        dfols.solve(
            function,
            x0,
            bounds=(np.zeros(DIM), np.ones(DIM)),
            rhobeg=0.1,
            maxfun=60,
            objfun_has_noise=True,
            user_params={"restarts.use_restarts": True},
            do_logging=False,
        )
    finally:
        np.random.set_state(users)
    ours = DFOLS(DIM, TARGET, seed=7)
    for point in points:
        X = ours.ask()
        np.testing.assert_array_equal(X[0], np.clip(point, 0.0, 1.0))
        ours.tell(X, smooth(X))
    assert len(points) > 3 * DIM


def test_a_smooth_problem_is_solved_in_few_renders() -> None:
    opt = DFOLS(DIM, TARGET, seed=0)
    while opt.evaluations < 60:
        X = opt.ask()
        opt.tell(X, smooth(X))
    assert opt.best is not None and opt.best.loss < 1e-10


def test_without_the_package_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dfols", None)
    with pytest.raises(DependencyError, match=r"pip install DFO-LS .*extra dfols"):
        DFOLS(DIM, TARGET)


def points_of(name: str, evaluations: int, **options: Any) -> Float64:
    opt = optimizers.make(name, 3, seed=5, **options)
    points = []
    while opt.evaluations < evaluations:
        X = opt.ask()
        opt.tell(X, losses=sphere(X))
        points.append(X)
    return np.concatenate(points)


def test_nevergrads_points_are_its_own() -> None:
    array = nevergrad.p.Array(init=np.full(3, 0.5), lower=0.0, upper=1.0)
    bits = np.random.MT19937(np.random.SeedSequence(5))
    array.random_state = np.random.RandomState(bits)
    theirs = nevergrad.optimizers.registry["OnePlusOne"](array, budget=77, num_workers=1)
    for x in points_of("nevergrad:OnePlusOne", 60, budget=77):
        candidate = theirs.ask()
        np.testing.assert_array_equal(x, np.clip(candidate.value, 0.0, 1.0))
        theirs.tell(candidate, float(sphere(candidate.value[None])[0]))


def test_optunas_points_are_its_own_after_the_center() -> None:
    seed = int(np.random.SeedSequence(5).generate_state(1)[0])
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    study.enqueue_trial({f"x{i}": 0.5 for i in range(3)})
    X = points_of("optuna:TPESampler", 25)
    np.testing.assert_array_equal(X[0], np.full(3, 0.5))
    for x in X:
        trial = study.ask()
        theirs = [trial.suggest_float(f"x{i}", 0.0, 1.0) for i in range(3)]
        np.testing.assert_array_equal(x, theirs)
        study.tell(trial, float(sphere(np.array([theirs]))[0]))


@pytest.mark.parametrize(
    ("name", "known"), [("nevergrad:NGOptt", "NGOpt"), ("optuna:TPESample", "TPESampler")]
)
def test_unknown_names_are_named(name: str, known: str) -> None:
    with pytest.raises(UnknownNameError, match=f"did you mean '{known}"):
        optimizers.make(name, 2)


@pytest.mark.parametrize("name", ["nevergrad:", "pyswarm:PSO", "nevergrad"])
def test_unknown_families_are_named(name: str) -> None:
    with pytest.raises(UnknownNameError, match="nevergrad:NAME, .*optuna:NAME"):
        optimizers.make(name, 2)


@pytest.mark.parametrize("family", ["nevergrad", "optuna"])
def test_without_a_framework_it_is_named(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [family, *(name for name in sys.modules if name.startswith(f"{family}."))]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(DependencyError, match=f"pip install {family} .*extra {family}"):
        optimizers.make(f"{family}:Unheard", 2)


@pytest.mark.parametrize("step", ["ask", "tell", "provide_recommendation"])
def test_an_error_of_the_framework_is_said_to_be_its_own(
    step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt: Any = optimizers.make("nevergrad:OnePlusOne", 3, seed=5, budget=77)
    opt.tell(opt.ask(), losses=[1.0])

    def fails(*_: Any) -> Any:
        raise TypeError("only 0-dimensional arrays can be converted")

    monkeypatch.setattr(opt._library, step, fails)
    with pytest.raises(OptimizerError) as caught:
        opt.tell(opt.ask(), losses=[1.0])
        opt.recommend()
    said = str(caught.value)
    assert said.startswith("nevergrad:OnePlusOne failed after ") and "budget of 77" in said
    assert f"nevergrad {nevergrad.__version__}: TypeError: only 0-dimensional" in said
    assert said.endswith("use another optimizer than OnePlusOne, or another version of nevergrad")
    assert isinstance(caught.value.__cause__, TypeError)
