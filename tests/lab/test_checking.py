"""What a check of a renderer finds: parameters, values, noise, failures, what to plan."""

from __future__ import annotations

import sys
from typing import Any

import cloudpickle
import numpy as np
import pytest

from fide_lab.checking import Facts, advice, as_data, check, effects_in, lines
from fide_plugins import Choice, Float, Group, Int, Space

# Workers get the functions of this file: away from the repository they cannot import it.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


def grid() -> tuple[Any, Any]:
    v, u = np.mgrid[-1:1:12j, -1:1:16j]
    return v, u


# -- parameters ------------------------------------------------------------------------------------


def test_values_of_each_kind_of_parameter() -> None:
    space = Space(
        x=Float(-1, 3, unit="m"), gain=Float(0.01, 1, log=True), few=Int(2, 4), many=Int(0, 100),
        turns=Float(0, 1, step=0.25), two=Choice("a", "b"),
        letters=Choice(*"abcdefgh"), one=Choice("only"), dots=2 * Group(y=Float(0, 1)),
    )  # fmt: skip
    center = np.full(space.dim, 0.5)
    found = effects_in(space, center)
    assert {one.name: one.texts for one in found} == {
        "x": ["-1", "1", "3"],
        "gain": ["0.01", "0.1", "1"],
        "few": ["2", "3", "4"],
        "many": ["0", "25", "50", "75", "100"],
        "turns": ["0", "0.25", "0.5", "0.75", "1"],
        "two": ["a", "b"],
        "letters": ["a", "c", "e", "f", "h"],
        "dots[0].y": ["0", "0.5", "1"],
        "dots[1].y": ["0", "0.5", "1"],
    }
    for one in found:
        others = np.setdiff1d(np.arange(space.dim), one.axes)
        assert (one.X[:, others] == 0.5).all()
    (first, *_) = effects_in(2, np.array([0.5, 0.5]))
    assert first.texts == ["0", "0.5", "1"] and first.name == "x[0]"
    np.testing.assert_array_equal(first.X, [[0, 0.5], [0.5, 0.5], [1, 0.5]])


def shown(facts: Facts) -> list[bool | None]:
    return [facts.shows(one) for one in facts.effects]


def test_things_of_one_kind_do_not_hide_each_other_at_the_center() -> None:
    """With all of them at the middle, only the last one would be seen."""
    space = Space(dots=3 * Group(x=Float(0, 1), gray=Float(0.2, 1)), light=Float(0, 1))

    def render(p: dict[str, Any]) -> Any:
        v, u = grid()
        image = np.zeros(u.shape)
        for dot in p["dots"]:
            image = np.where(np.hypot(u - 2 * dot["x"] + 1, v) < 0.2, dot["gray"], image)
        return image * (0.5 + p["light"] / 2)

    facts = check(render, space, workers=1)
    assert all(shown(facts))
    assert isinstance(facts.center, dict) and facts.center["light"] == 0.5 and facts.centered


def test_noise_hides_no_parameter_that_changes_nothing() -> None:
    def render(p: dict[str, Any]) -> Any:
        noise = np.random.default_rng().normal(0, 0.02, (24, 32))
        return np.clip(0.5 + 0.2 * p["gray"] + noise, 0, 1)

    facts = check(render, Space(gray=Float(0, 1), unread=Float(0, 1)), workers=1)
    assert shown(facts) == [True, False]
    assert facts.noise is not None and 0.025 < facts.noise < 0.032  # sqrt(2) 0.02
    data = as_data("noisy", facts)
    assert data["noise"] == facts.noise
    assert "cannot be told from noise" in " ".join(data["advice"])
    assert "--until stalled" in " ".join(data["advice"])


def test_nothing_is_planned_where_no_parameter_changes_the_image() -> None:
    facts = check(lambda p: np.zeros((6, 8)), Space(x=Float(0, 1), y=Float(0, 1)), workers=0)
    (told,) = advice(facts)
    assert told.startswith("x, y: changes nothing at the center")


# -- values ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scale", "span", "text"),
    [
        (1.0, 1.0, ""),
        (250.0, 250.0, "of 0 to 255 return image / 255"),
        (10.0, 10.0, "value_range=(0, 10) or --value-range 0 10"),
    ],
)
def test_ranges_of_values(scale: float, span: float, text: str) -> None:
    def render(p: dict[str, Any]) -> Any:
        _, u = grid()
        return scale * p["gray"] * (u + 1) / 2

    facts = check(render, Space(gray=Float(0, 1)), workers=1)
    assert facts.span == pytest.approx(span)
    change = facts.effects[0].change
    assert change == pytest.approx(scale * 0.588, rel=0.01)
    told = " ".join(advice(facts))
    assert text in told and ("[0, 1]" in told) == (scale > 1)


# -- failures --------------------------------------------------------------------------------------


def test_failures_are_counted_by_kind_and_the_center_is_one_that_renders() -> None:
    def render(p: dict[str, Any]) -> Any:
        if 0.45 < p["x"] < 0.55:
            raise ValueError(f"the wall is {p['x']:.3f} m")
        image = np.full((6, 8 + 2 * (p["n"] == 3)), p["x"])
        image[0, 0] = np.nan if p["x"] == 1 else 0
        return image

    facts = check(render, Space(x=Float(0, 1), n=Int(1, 3)), workers=1)
    (failure,) = facts.failures
    assert failure.reason.startswith("ValueError: the wall is 0.500") and failure.count >= 2
    assert not facts.centered and isinstance(facts.center, dict)
    assert facts.images + facts.failed == facts.renders and facts.not_finite >= 1
    text = "\n".join(lines("scene.py:render", facts))
    for shown in ("the middle of the ranges gives no image", "the size of the image changes",
                  "NaN or infinite values in", "no image at 0.5", "center    x="):  # fmt: skip
        assert shown in text


def test_nothing_but_failures() -> None:
    def render(p: dict[str, Any]) -> Any:
        raise ValueError("never")

    facts = check(render, Space(x=Float(0, 1)), workers=1)
    assert facts.images == 0 and facts.failures[0].count == facts.renders == 9
    assert "mend the renderer first" in lines("x", facts)[-1]
    data = as_data("x", facts)
    assert data["values"] is None and data["parameters"] == []


@pytest.mark.thorough
def test_what_ends_its_process_or_hangs_needs_one_of_its_own() -> None:
    def render(p: dict[str, Any]) -> Any:
        import os
        import time

        if p["x"] > 0.9:
            os._exit(3)
        if p["x"] < 0.1:
            time.sleep(60)
        return np.full((6, 8), p["x"])

    facts = check(render, Space(x=Float(0, 1)), workers=2, timeout=0.5)
    reasons = " ".join(one.reason for one in facts.failures)
    assert "died with exit code 3" in reasons and "did not end within 0.5 s, its" in reasons
    assert "--timeout" not in reasons
    assert facts.kills and facts.workers >= 1


def test_renders_to_plan() -> None:
    planned = [Facts(dim, dim, median=1.0, number=4) for dim in (3, 40, 100, 160)]
    assert [facts.budget for facts in planned] == [2000, 4000, 10_000, 24_000]
    assert planned[0].workers == 4 and planned[0].seconds_of_fit == pytest.approx(502)
    assert Facts(2, 2, median=0.001, number=4).workers == 0


def test_views_types_and_wrong_images() -> None:
    images = iter([[np.zeros((4, 6), np.uint8), np.ones((2, 3, 4), np.float32)], None, "no.png"])
    facts = check(lambda x: next(images, np.zeros((4, 6, 5))), 1, workers=0)
    assert facts.shapes == [((4, 6, 1), (2, 3, 4))] and facts.kinds == ["uint8", "float32"]
    assert facts.images == 1 and facts.failed == facts.renders - 1


def test_points_that_violate_constraints_are_not_rendered() -> None:
    space = Space(
        inner=Float(0, 1), outer=Float(0, 1), x=Float(0, 1), constraints={"wall": "inner < outer"}
    )

    def render(p: dict[str, Any]) -> Any:
        assert p["inner"] < p["outer"]
        v, u = grid()
        far = np.hypot(u - p["x"], v)
        return ((far > p["inner"]) & (far < p["outer"])) * 1.0

    facts = check(render, space, workers=1)
    assert facts.failed == 0 and facts.rejected > 2 and not facts.centered
    assert all(shown(facts))
    text = "\n".join(lines("x", facts))
    assert "violate constraints, and were not rendered" in text and "no image at 1" in text
