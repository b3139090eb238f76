"""Renderers that know what is valid: fits find valid parameters, and report broken ones at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Space, fit
from fide_plugins.fitting.failures import GivenUpError, RenderFailedWarning

from .scene import SPACE, disk, target

RING: dict[str, Any] = {"inner": Float(0.05, 0.45), "outer": Float(0.05, 0.45), "x": Float(0, 1)}
ANSWER = {"inner": 0.1, "outer": 0.4, "x": 0.6}


def ring(params: dict[str, float]) -> Any:
    """Picture of a ring; 72 % of the box is invalid, the middle too."""
    if params["inner"] >= 0.6 * params["outer"]:
        raise ValueError("wall too thin")
    v, u = np.mgrid[0:24, 0:24] / 23
    d = np.hypot(u - params["x"], v - 0.5)
    return 1 / (1 + np.exp(30 * (d - params["outer"]))) - 1 / (
        1 + np.exp(30 * (d - params["inner"]))
    )


def thick(params: dict[str, float]) -> bool:
    return params["inner"] < 0.6 * params["outer"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("how", ["nobody says", "function", "space"])
def test_what_is_valid_is_found(how: str, seed: int) -> None:
    wall = {"wall": "inner < 0.6 * outer"} if how == "space" else None
    space = Space(RING, constraints=wall)
    given: dict[str, Any] = {"constraints": thick} if how == "function" else {}
    limits: dict[str, Any] = {"budget": 250, "stop_at": 1e-7, "workers": 0, "seed": seed}
    if how == "nobody says":
        with pytest.warns(RenderFailedWarning, match="wall too thin"):
            result = fit(ring, ring(ANSWER), space, **limits)
        assert result.failures > 8 and result.rejected is None
    else:
        result = fit(ring, ring(ANSWER), space, **limits, **given)
        assert result.failures == 0 and result.rejected and "rejected" in repr(result)
    assert result.params == pytest.approx(ANSWER, abs=0.01)


@pytest.mark.parametrize(
    ("error", "tries"),
    [
        (NameError, 8), (TypeError, 8), (KeyError, 8), (FileNotFoundError, 8), (ImportError, 8),
        (ValueError, 200), (AssertionError, 200), (ZeroDivisionError, 200),
    ],
)  # fmt: skip
def test_a_broken_renderer_ends_the_fit_soon(error: type[Exception], tries: int) -> None:
    where = []

    def render(params: dict[str, float]) -> Any:
        where.append(list(params.values()))
        raise error("broken")

    with (
        pytest.warns(RenderFailedWarning, match="broken"),
        pytest.raises(GivenUpError, match=f"the first {tries} renders all failed.*broken"),
    ):
        fit(render, target(), SPACE, workers=0, seed=0)
    assert len(where) == tries
    if tries > 8:  # they were all over the space
        assert np.ptp(np.array(where)[8:], axis=0) == pytest.approx([1, 1, 0.4, 1], rel=0.1)


def test_images_of_nan_say_that_parameters_are_invalid_and_of_a_wrong_size_do_not() -> None:
    sizes = []

    def render(params: dict[str, float]) -> Any:
        sizes.append(1)
        return np.full((16, 16), np.nan) if params["x"] < 0.8 else disk()(params)

    answer = {"x": 0.9, "y": 0.35, "radius": 0.3, "gray": 0.9}
    with pytest.warns(RenderFailedWarning, match="must be finite"):
        assert fit(render, disk()(answer), SPACE, budget=20, workers=0, seed=0).evaluations == 20
    with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError, match="first 8"):
        fit(lambda _: np.zeros((3, 3)), target(), SPACE, workers=0, seed=0)


def test_a_search_that_fails_most_of_the_time_goes_on_unless_the_user_says_otherwise() -> None:
    count = iter(range(10**6))

    def render(params: dict[str, float]) -> Any:
        if next(count) % 10:
            raise ValueError("unlucky")
        return disk()(params)

    with pytest.warns(RenderFailedWarning):
        result = fit(render, target(), SPACE, budget=20, workers=0, seed=0)
    assert (result.evaluations, result.failures) == (20, 171)
    with (
        pytest.warns(RenderFailedWarning),
        pytest.raises(GivenUpError, match="45 of the last 50 renders failed, more than max_failur"),
    ):
        fit(render, target(), SPACE, budget=20, workers=0, seed=0, max_failures=0.8)


def test_a_run_directory_goes_on_with_the_same_constraints_only(tmp_path: Path) -> None:
    limits: dict[str, Any] = {"workers": 0, "out": tmp_path / "out", "seed": 0}
    space, picture = Space(RING), ring(ANSWER)
    fit(ring, picture, space, budget=12, constraints=thick, **limits)
    with pytest.raises(FileExistsError, match="constraints"):
        fit(ring, picture, space, budget=24, resume=True, **limits)
    resumed = fit(ring, picture, space, budget=24, resume=True, constraints=thick, **limits)
    whole = fit(ring, picture, space, budget=24, constraints=thick, workers=0, seed=0)
    np.testing.assert_array_equal(resumed.curve, whole.curve)
