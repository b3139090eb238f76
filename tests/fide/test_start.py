"""Where a search begins, and how wide, in each parameter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fide_plugins import Float, Group, Int, Space, fit
from fide_plugins.errors import OptionError, PointsError, SpaceError
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render

X0, SIGMA0 = np.array([0.5, 0.3, 0.6]), np.array([0.01, 0.05, 0.1])


def test_the_first_generation_is_drawn_around_it(target: Float32) -> None:
    X = FIDE(3, target, x0=X0, sigma0=SIGMA0, popsize=5000, seed=0).ask()
    np.testing.assert_allclose(X.mean(axis=0), X0, atol=0.006)
    np.testing.assert_allclose(X.std(axis=0), SIGMA0, rtol=0.05)


def test_the_middle_is_where_it_begins_by_default(target: Float32, render: Render) -> None:
    """It is asked only where it was given."""
    default = FIDE(3, target, popsize=6, seed=0)
    said = FIDE(3, target, x0=None, sigma0=np.full(3, 1 / 6), popsize=6, seed=0)
    given = FIDE(3, target, x0=np.full(3, 0.5), popsize=6, seed=0).ask()
    np.testing.assert_array_equal(given[0], np.full(3, 0.5))
    for generation in range(10):
        X = default.ask()
        np.testing.assert_array_equal(X, said.ask())
        if generation == 0:
            np.testing.assert_array_equal(X[1:], given[1:])
        default.tell(X, render(X))
        said.tell(X, render(X))


@pytest.mark.parametrize("x0", [[0.5], [0.5, 0.5, 1.1], [0.5, 0.5, np.nan], "middle", 0.5])
def test_no_point_of_the_cube(x0: object, target: Float32) -> None:
    with pytest.raises(PointsError, match="x0 must be a point of the cube"):
        FIDE(3, target, x0=x0)


SPACE = Space(angle=Float(-60, 60, unit="deg"), columns=Int(3, 8), dots=1 * Group(x=Float(0, 2)))
GUESS = {"angle": 30.0, "columns": 4, "dots": [{"x": 0.5}]}


def test_it_may_be_given_as_physical_values(target: Float32, tmp_path: Path) -> None:
    named, point = (FIDE(SPACE, target, x0=x, seed=0) for x in (GUESS, SPACE.encode(GUESS)))
    np.testing.assert_array_equal(named.ask(), point.ask())
    named.save(tmp_path / "c")
    np.testing.assert_array_equal(FIDE.load(tmp_path / "c").x0, SPACE.encode(GUESS))
    result = fit(
        lambda params: target * (params["angle"] + 60) / 120,
        target, SPACE, budget=6, workers=0, seed=0, x0=GUESS, sigma0=1e-3,
    )  # fmt: skip
    assert result.params["angle"] == pytest.approx(30, abs=1)


def test_physical_values_that_are_none(target: Float32) -> None:
    with pytest.raises(PointsError, match="x0 is a dictionary of parameters, which needs a Space"):
        FIDE(3, target, x0=GUESS)
    with pytest.raises(SpaceError, match="x0: parameter 'angle' must be a value of"):
        FIDE(SPACE, target, x0={**GUESS, "angle": 90})
    with pytest.raises(SpaceError, match="x0: missing parameter 'columns', 'dots'"):
        FIDE(SPACE, target, x0={"angle": 0})
    with pytest.raises(PointsError, match="to give values, pass a dictionary of them"):
        FIDE(SPACE, target, x0=[30, 4, 0.5])


@pytest.mark.parametrize("sigma0", [[0.1], [0.1, 0.1, 0.0], np.full((3, 1), 0.1)])
def test_no_standard_deviations(sigma0: Float64, target: Float32) -> None:
    with pytest.raises(OptionError, match="sigma0 must"):
        FIDE(3, target, sigma0=sigma0)
