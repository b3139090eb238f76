"""Standardized space as a unit cube; any parametrization, alone and in portfolios (point 24)."""

from __future__ import annotations

import warnings
from typing import Any

import nevergrad as ng
import numpy as np
import pytest
from nevergrad.optimization.optimizerlib import Chaining, ConfPortfolio
from nevergrad.parametrization import helpers

from fide_adapters.nevergrad import NoImagesWarning, ParametrizedFIDE
from fide_adapters.nevergrad.parametrization import Cube, _Axes
from fide_plugins import FIDE as Core, Choice, Float, Int
from fide_plugins.types import Float32

from .conftest import TARGET, box, fide, mse, render

pytestmark = pytest.mark.filterwarnings("ignore::nevergrad.common.errors.NevergradWarning")

P = ng.p


# -- the unit cube ---------------------------------------------------------------------------------

INF = np.inf
AXES: dict[str, tuple[Any, list[float], list[float]]] = {
    "box": (P.Array(shape=(2,), lower=0, upper=1), [-3, -3], [3, 3]),
    "box of its own": (P.Array(shape=(2,), lower=[0, 1], upper=[1, 5]), [-3, -3], [3, 3]),
    "box with steps": (P.Array(init=[0.0, 1.0]).set_bounds(-5, 5), [-5, -6], [5, 4]),
    "constraint": (P.Array(init=[2.0]).set_bounds(-5, 5, method="constraint"), [-7], [3]),
    "no bounds": (P.Array(shape=(2,)), [-INF, -INF], [INF, INF]),
    "arctan": (P.Array(shape=(1,)).set_bounds(-5, 5, method="arctan"), [-INF], [INF]),
    "tanh": (P.Array(shape=(1,)).set_bounds(-5, 5, method="tanh"), [-INF], [INF]),
    "lower": (P.Array(init=[2.0, 3.0]).set_bounds(2, None, method="clipping"), [0, -1], [INF, INF]),
    "upper": (P.Array(init=[2.0]).set_bounds(None, 3, method="clipping"), [-INF], [1]),
    "turned": (-P.Array(init=[3.0]).set_bounds(2, None, method="clipping"), [-1], [INF]),
    "scaled": (3 * P.Array(shape=(1,), lower=0, upper=1) + 1, [-3], [3]),
    "scalar": (P.Scalar(lower=0.1, upper=0.7), [-3], [3]),
    "off center": (P.Scalar(init=0.2, lower=0.1, upper=0.7), [-1], [5]),
    "log": (P.Log(lower=1e-3, upper=10), [-3], [3]),
    "log without bounds": (P.Log(init=2.0), [-INF], [INF]),
    "whole without bounds": (P.Scalar().set_integer_casting(), [-INF], [INF]),
    "nested": (
        P.Instrumentation(
            P.Array(shape=(2,), lower=0, upper=1),
            b=P.Dict(z=P.Scalar(), a=P.Log(lower=1, upper=2)),
            a=P.Tuple(P.Scalar(init=5, lower=4, upper=10), 3),
        ),
        [-3, -3, -1, -3, -INF],
        [3, 3, 5, 3, INF],
    ),
}


def standardized(cube: Cube, kind: str, x: Any) -> Any:
    parametrization = AXES[kind][0]
    return cube.candidate(x).get_standardized_data(reference=parametrization)


@pytest.mark.parametrize("kind", AXES)
def test_numbers_are_axes_from_bound_to_bound(kind: str) -> None:
    parametrization, lower, upper = AXES[kind]
    cube = Cube(parametrization)
    assert cube.space is not None and not cube.space.layout.discrete.any()
    for end, bounds in ((0, lower), (1, upper)):
        axes = _Axes(np.array(lower, float), np.array(upper, float))
        z = axes.from_cube(np.full(cube.space.dim, float(end)))
        finite = np.isfinite(bounds)
        np.testing.assert_allclose(z[finite], np.array(bounds)[finite], atol=1e-9)
        assert (np.abs(z[~finite]) > 1e8).all() and np.isfinite(z).all()
    for x in np.random.default_rng(0).random((20, cube.space.dim)):
        np.testing.assert_allclose(cube.point(cube.candidate(x)), x, atol=1e-9)


@pytest.mark.parametrize("kind", AXES)
def test_it_begins_where_the_user_does_and_as_wide(kind: str) -> None:
    """The deviation is the width in the cube of one natural step, measured."""
    parametrization, lower, upper = AXES[kind]
    cube, axes = Cube(parametrization), _Axes(np.array(lower, float), np.array(upper, float))
    start = np.full(len(lower), 0.5) if cube.guess is None else cube.guess
    np.testing.assert_allclose(axes.from_cube(start), 0.0, atol=1e-12)
    np.testing.assert_allclose(standardized(cube, kind, start), 0.0, atol=1e-9)
    h = 1e-6
    one_sided = (axes.to_cube(np.full(axes.dim, h)) - start) / h
    other = (start - axes.to_cube(np.full(axes.dim, -h))) / h
    slope = np.maximum(one_sided, other)  # at a bound, one of them is zero
    np.testing.assert_allclose(cube.std, np.minimum(slope, 1 / 3), rtol=1e-4)


VALUES: dict[str, tuple[Any, list[Any]]] = {
    "whole": (P.Scalar(lower=-3, upper=9).set_integer_casting(), [Int(-3, 9)]),
    "whole, between fractions": (P.Scalar(lower=0.3, upper=4.6).set_integer_casting(), [Int(1, 4)]),
    "whole, array": (
        P.Array(init=[[3.0], [3.0]]).set_bounds(0, 7).set_integer_casting(),
        [Int(0, 7)] * 2,
    ),
    "whole, no bounds in its own space": (
        P.Array(shape=(2,)).set_bounds(-2, 2, method="arctan").set_integer_casting(),
        [Int(-2, 2)] * 2,
    ),
    "whole, log": (P.Log(lower=1, upper=64).set_integer_casting(), [Int(1, 64, log=True)]),
    "whole, log, odd": (P.Log(lower=3, upper=50).set_integer_casting(), [Int(3, 50, log=True)]),
    "ordered": (P.TransitionChoice([3, 5, 7]), [Int(0, 2)]),
    "choice": (P.Choice(["a", "b", "c"]), [Choice(0, 1, 2)]),
    "choices": (P.Choice([5, 6], repetitions=3, deterministic=True), [Choice(0, 1)] * 3),
    "angles": (P.Angles(shape=(2,)), [Float(-np.pi, np.pi, periodic=True)] * 2),
    "degrees": (P.Angles(shape=(1,), deg=True), [Float(-180, 180, periodic=True)]),
    "one value": (P.Choice(["a"]), [Float(0, 1)]),
}


@pytest.mark.parametrize("kind", VALUES)
def test_other_parameters_are_those_of_a_space(kind: str) -> None:
    parametrization, kinds = VALUES[kind]
    cube = Cube(parametrization)
    assert cube.space is not None and list(cube.space.parameters.values()) == kinds
    assert cube.guess is None or kind == "whole, array"  # 3 is not the middle of 0 and 7
    leaf = helpers.list_data(cube.candidate(np.full(cube.space.dim, 0.5)))[0]
    for x in np.random.default_rng(0).random((40, cube.space.dim)):
        candidate = cube.candidate(x)
        leaf = helpers.list_data(candidate)[0]
        if kinds != [Float(0, 1)]:
            own = [kind.value(n) for kind, n in zip(kinds, np.ravel(leaf.value), strict=True)]
            np.testing.assert_allclose(own, list(cube.space.decode(x).values()), atol=1e-9)
        snapped = cube.space.snap(x)
        np.testing.assert_allclose(cube.point(candidate), snapped, atol=1e-9)


def test_a_choice_that_a_user_has_made_is_where_the_search_begins() -> None:
    parametrization = P.Dict(
        a=P.Choice(["a", "b", "c"]),
        n=P.Scalar(lower=0, upper=9).set_integer_casting(),
        x=P.Scalar(lower=0, upper=1),
    )
    parametrization.value = {"a": "c", "n": 7, "x": 0.25}
    cube = Cube(parametrization)
    assert cube.space is not None and cube.guess is not None
    expected = cube.space.encode({"p0": 2, "p1": 7, "p2": 0.25})
    np.testing.assert_allclose(cube.guess, expected)
    optimizer = fide(parametrization)
    assert optimizer.ask().value == {"a": "c", "n": 7, "x": 0.25}


# -- candidates ------------------------------------------------------------------------------------


def kinds() -> dict[str, Any]:
    """New ones each time: optimizers freeze them, and they hold random state."""
    nested = P.Instrumentation(
        P.Array(shape=(2, 2), lower=-1, upper=2),
        P.Choice(["a", "b"]),
        scale=P.Log(lower=1e-3, upper=10),
        depth=P.Dict(
            n=P.Scalar(lower=1, upper=12).set_integer_casting(),
            kind=P.TransitionChoice([3, 5, 7]),
            free=P.Tuple(P.Scalar(), "constant"),
        ),
    )
    return {
        "box": P.Array(shape=(3,), lower=0, upper=1),
        "one parameter": P.Scalar(lower=-5, upper=-4),
        "off center": P.Array(init=[0.1, 0.9]).set_mutation(sigma=0.3).set_bounds(0, 1),
        "on the bound": P.Array(init=[0.0, 3.0]).set_bounds(0, 3),
        "clipping": P.Array(shape=(2,)).set_bounds(-1, None, method="clipping"),
        "arctan": P.Array(shape=(2,)).set_bounds(-2, 2, method="arctan"),
        "constraint": P.Array(shape=(2,)).set_bounds(-2, 2, method="constraint"),
        "log": P.Log(lower=1e-3, upper=10),
        "whole": P.Array(init=[3.0, 3.0]).set_bounds(0, 7).set_integer_casting(),
        "choices": P.Choice([0.0, 0.5, 1.0], repetitions=2),
        "nested": nested,
    }


def numbers(value: Any) -> list[float]:
    """All numbers in a value."""
    if isinstance(value, dict):
        return [n for v in value.values() for n in numbers(v)]
    if isinstance(value, tuple | list):
        return [n for v in value for n in numbers(v)]
    if isinstance(value, np.ndarray):
        return [float(n) for n in value.ravel()]
    return [] if isinstance(value, str) else [float(value)]


def check(kind: str, value: Any) -> None:
    """Kind and bounds of one value."""
    assert np.isfinite(numbers(value)).all()
    x = np.array(numbers(value))
    match kind:
        case "box" | "off center":
            assert ((x >= 0) & (x <= 1)).all()
        case "one parameter":
            assert isinstance(value, float) and -5 <= value <= -4
        case "on the bound":
            assert ((x >= 0) & (x <= 3)).all()
        case "clipping":
            assert (x >= -1).all()
        case "arctan" | "constraint":
            assert ((x >= -2) & (x <= 2)).all()
        case "log":
            assert 1e-3 * (1 - 1e-9) <= value <= 10 * (1 + 1e-9)
        case "whole":
            assert value.dtype.kind == "i" and ((x >= 0) & (x <= 7)).all()
        case "choices":
            assert all(v in (0.0, 0.5, 1.0) for v in value) and len(value) == 2
        case "nested":
            (array, letter), named = value
            assert ((array >= -1) & (array <= 2)).all() and letter in "ab"
            assert 1e-3 * (1 - 1e-9) <= named["scale"] <= 10 * (1 + 1e-9)
            depth = named["depth"]
            assert isinstance(depth["n"], int) and 1 <= depth["n"] <= 12
            assert depth["kind"] in (3, 5, 7) and depth["free"][1] == "constant"


def picture(value: Any) -> Float32:
    x = np.resize(np.array(numbers(value)), 6)
    return render(1 / (1 + np.exp(-x)))


@pytest.mark.parametrize("kind", kinds())
def test_point_24_candidates_are_inside_whatever_is_told(kind: str) -> None:
    """In a run with images, failures, and extreme losses."""
    optimizer = fide(kinds()[kind], options={"patience": 3})
    check(kind, optimizer.recommend().value)
    losses = [None, 1.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0]
    for step in range(48):
        candidate = optimizer.ask()
        check(kind, candidate.value)
        image = picture(candidate.value)
        loss = losses[step % 8] if 12 < step < 30 else None
        optimizer.tell(candidate, image if loss is None else loss)
        check(kind, optimizer.recommend().value)
    assert optimizer.num_tell == 48 and optimizer.fide.not_finite > 0


@pytest.mark.parametrize("kind", ["box", "whole", "nested"])
def test_point_24_the_mean_is_recommended_where_renders_are_noisy(kind: str) -> None:
    optimizer = fide(kinds()[kind])
    optimizer.parametrization.function.deterministic = False
    for _ in range(15):
        check(kind, optimizer.recommend().value)
        candidate = optimizer.ask()
        optimizer.tell(candidate, picture(candidate.value))
    if kind == "box":
        mean = optimizer.fide.recommend()
        np.testing.assert_allclose(optimizer.recommend().value, mean, atol=1e-12)


@pytest.mark.parametrize("kind", ["portfolio", "chain"])
def test_point_24_among_other_optimizers_it_gets_their_losses(kind: str) -> None:
    """No images, so it says once that it is CMA-ES; the candidates are inside."""
    fides, other = ParametrizedFIDE(target=TARGET, seed=0), ng.optimizers.OnePlusOne
    make = (
        ConfPortfolio(optimizers=[fides, other])
        if kind == "portfolio"
        else Chaining([fides, other], [20])
    )
    optimizer = make(box(), budget=40)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NoImagesWarning)
        losses = []
        for _ in range(40):
            candidate = optimizer.ask()
            check("box", candidate.value)
            losses.append(mse(render(candidate.value)))
            optimizer.tell(candidate, losses[-1])
    assert [each.category for each in caught].count(NoImagesWarning) == 1
    assert mse(render(optimizer.recommend().value)) < losses[0]


def test_a_candidate_that_violates_a_cheap_constraint_is_withdrawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    withdrawn: list[Any] = []
    ask, withdraw = Core.ask, Core.withdraw

    def spy_ask(self: Core, n: int | None = None) -> Any:
        asked.append(ask(self, n))
        return asked[-1]

    def spy_withdraw(self: Core, X: Any) -> None:
        withdrawn.append(X)
        withdraw(self, X)

    monkeypatch.setattr(Core, "ask", spy_ask)
    monkeypatch.setattr(Core, "withdraw", spy_withdraw)
    parametrization = box(6)
    parametrization.register_cheap_constraint(right_half)
    optimizer = fide(parametrization)
    for _ in range(60):
        candidate = optimizer.ask()
        assert candidate.value[0] >= 0.5
        optimizer.tell(candidate, render(candidate.value))
    assert len(asked) == 60 + len(withdrawn) and all(x[0] < 0.5 for (x,) in withdrawn)
    assert withdrawn and optimizer.fide.evaluations == 60
    assert optimizer.fide.best.loss < 0.01


def right_half(x: Any) -> bool:
    return bool(x[0] >= 0.5)
