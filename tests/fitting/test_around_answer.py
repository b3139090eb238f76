"""`fit` says how sure its answer is, by a few renders around it."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Choice, Float, Space, fit, load_run
from fide_plugins.fitting.result import Result
from fide_plugins.types import Float64

V, U = np.mgrid[0:32, 0:32] / 31
SPACE = Space(x=Float(0, 1), angle=Float(0, 1, periodic=True), kind=Choice("disk", "square"))
TRUTH = {"x": 0.6, "angle": 0.98, "kind": "disk"}


def draw(p: Mapping[str, Any]) -> Float64:
    """A soft disk or square (32, 32); the angle moves it up and down."""
    u, v = U - p["x"], V - 0.5 - 0.2 * np.sin(2 * np.pi * p["angle"])
    distance = np.hypot(u, v) if p["kind"] == "disk" else np.maximum(abs(u), abs(v))
    return np.asarray(0.1 + 0.8 / (1 + np.exp(30 * (distance - 0.2))), np.float64)


GAP = np.maximum(draw(TRUTH), 0.3) * (0.8 + 0.15 * V)


def fitted(target: Float64, seed: int, **options: Any) -> Result:
    return fit(draw, target, SPACE, workers=0, seed=seed, **{"budget": 160, **options})


def deviations(result: Result) -> Float64:
    assert result.best is not None and result.best.std is not None
    return result.best.std


def by_samples(result: Result) -> Float64:
    best = None if result.optimizer is None else result.optimizer.best
    assert best is not None and best.std is not None
    return np.asarray(best.std, np.float64)


def test_they_do_not_depend_on_the_path_of_the_search() -> None:
    """Also of a picture that cannot be drawn."""
    results = [fitted(GAP, seed) for seed in range(3)]
    found = np.array([deviations(one)[0] for one in results])
    assert np.ptp(found) < 0.1 * found.min()
    assert np.isnan(deviations(results[0])[2:]).all()
    for one in results:
        assert one.stopped == "budget" and one.std_renders >= 5 and one.evaluations == 160
        assert one.solutions[0] is one.best


def test_a_solved_fit_knows_its_answer_well() -> None:
    """Its few samples would say 0.01 to 0.1."""
    for seed in range(3):
        result = fitted(draw(TRUTH), seed)
        assert result.stopped == "solved"
        error = SPACE.encode(result.params)[0] - SPACE.encode(TRUTH)[0]
        assert abs(error) < 4 * deviations(result)[0] < 0.02


def test_no_more_than_a_tenth_of_the_budget_and_none_of_a_renderer_with_noise() -> None:
    assert fitted(GAP, 0, budget=80).std_renders == 0
    assert fitted(GAP, 0, budget=100).std_renders >= 5
    rng = np.random.default_rng(0)

    def noisy(p: Mapping[str, Any]) -> Float64:
        return np.clip(draw(p) + 0.03 * rng.standard_normal((32, 32)), 0, 1)

    result = fit(noisy, GAP, SPACE, budget=120, workers=0, seed=0)
    assert result.std_renders == 0
    np.testing.assert_array_equal(deviations(result), by_samples(result))


def test_a_run_directory_tells_which_are_rough(tmp_path: Path) -> None:
    calls, last = 0, 161

    def render(p: Mapping[str, Any]) -> Float64:
        nonlocal calls
        calls += 1
        if calls > last:
            raise ValueError("no more")
        return draw(p)

    for name in ("rough", "sure"):
        calls, last, out = 0, 161 if name == "rough" else 1000, tmp_path / name
        result = fit(render, GAP, SPACE, budget=160, workers=0, seed=0, out=out)
        assert ("± rough" in repr(result)) == (name == "rough")
        read = load_run(tmp_path / name).solutions
        assert read[0].estimate is not None and read[0].estimate.rough == (name == "rough")
        assert pickle.loads(pickle.dumps(read[0])).estimate.rough == (name == "rough")


@pytest.mark.parametrize("wrong", ["raises", "size"])
def test_where_a_render_around_the_answer_fails_samples_say_it(wrong: str) -> None:
    calls = 0

    def render(p: Mapping[str, Any]) -> Any:
        nonlocal calls
        calls += 1
        if calls <= 162:
            return draw(p)
        if wrong == "raises":
            raise ValueError("no more")
        return np.zeros((3, 3))

    result = fit(render, GAP, SPACE, budget=160, workers=0, seed=0)
    assert result.std_renders == 0 and result.failures == 0
    assert all("± rough, from the search" in text for text in (repr(result), result._repr_html_()))
    np.testing.assert_array_equal(deviations(result), by_samples(result))


def test_of_an_image_that_changes_in_jumps_no_more_is_claimed_than_a_step_tells() -> None:
    def hard(p: Mapping[str, Any]) -> Float64:
        return np.where(draw(p) > 0.5, 0.8, 0.0)

    result = fit(hard, hard(TRUTH), SPACE, budget=300, workers=0, seed=0)
    error = abs(SPACE.encode(result.params)[0] - SPACE.encode(TRUTH)[0])
    assert result.std_renders == 9 and deviations(result)[0] >= 0.001
    assert result.stopped == "solved" and error < 0.5 / 31


def test_what_violates_constraints_is_not_rendered() -> None:
    """Also where the answer lies at the border."""
    seen = []

    def render(p: Mapping[str, Any]) -> Float64:
        seen.append(p["x"])
        return draw(p)

    result = fit(
        render, GAP, SPACE, budget=160, workers=0, seed=0, constraints=lambda p: p["x"] <= 0.59
    )
    assert max(seen) <= 0.59 and result.std_renders >= 5 and deviations(result)[0] > 0


ONE = Space(x=Float(0, 1))


def disk(p: Mapping[str, Any]) -> Float64:
    return draw({"x": p["x"], "angle": 0.98, "kind": "disk"})


def of_one(render: Any, truth: float, **options: Any) -> Result:
    return fit(
        render, render({"x": truth}), ONE, workers=0, **{"seed": 0, "budget": 200, **options}
    )


def test_one_side_is_enough_where_the_other_fails() -> None:
    solved, calls = of_one(disk, 0.6), 0

    def cliff(p: Mapping[str, Any]) -> Float64:
        nonlocal calls
        calls += 1
        if calls > solved.evaluations and p["x"] > 0.601:
            raise ValueError("no such scene")
        return disk(p)

    result = of_one(cliff, 0.6)
    assert result.stopped == "solved" and result.std_renders >= 4
    assert 0 < deviations(result)[0] < 0.01


@pytest.mark.parametrize("truth", [0.0, 1.0])
def test_a_wall_is_no_jump(truth: float) -> None:
    result = of_one(disk, truth)
    assert result.std_renders > 0
    assert abs(result.params["x"] - truth) < 1e-3
    assert 0 < deviations(result)[0] < 0.001


def test_the_step_grows_until_something_changes() -> None:
    """A picture of rows of pixels, which move by steps of 1 / 32."""

    def bar(p: Mapping[str, Any]) -> Float64:
        return np.where(np.floor(U * 31.5) < np.floor(32 * p["x"]), 0.8, 0.2)

    result = of_one(bar, 0.51)
    assert result.best is not None and not result.best.undetermined
    assert 0.002 < deviations(result)[0] < 0.1

    space = Space(x=Float(0, 1), nothing=Float(0, 1))
    for more in (9, 100):  # renders that the budget has left, or a tenth of what was made
        made = fit(disk, disk({"x": 0.6}), space, workers=0, seed=0, budget=200).evaluations
        unseen = fit(disk, disk({"x": 0.6}), space, workers=0, seed=0, budget=made + more)
        assert unseen.std_renders <= max(more, made // 5)
        assert unseen.best is not None and unseen.best.undetermined == ("nothing",)


def test_ctrl_c_around_the_answer_ends_the_fit_as_it_was() -> None:
    solved = of_one(disk, 0.6)
    calls = 0

    def interrupted(p: Mapping[str, Any]) -> Float64:
        nonlocal calls
        calls += 1
        if calls == solved.evaluations + 4:  # one is the target, one checks the renderer
            os.kill(os.getpid(), signal.SIGINT)
        return disk(p)

    result = of_one(interrupted, 0.6)
    assert calls == solved.evaluations + 4
    assert result.stopped == solved.stopped == "solved" and result.std_renders == 0


def test_slopes_of_jumps_say_nothing_of_a_photograph() -> None:
    """Pixels that are black or white jump; a search's samples say more."""

    def hard(p: Mapping[str, Any]) -> Float64:
        return np.where(np.hypot(U - p["x"], V - p["y"]) < 0.3, 0.8, 0.2)

    target, space = hard({"x": 0.62, "y": 0.43}), Space(x=Float(0, 1), y=Float(0, 1))
    found = [
        fit(hard, target, space, budget=160, workers=0, seed=0, photo=photo)
        for photo in (False, True)
    ]
    assert [one.std_renders > 0 for one in found] == [True, False]
    assert np.isfinite(deviations(found[1])).all()
