"""A space in an optimizer: what is told, found and saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, Choice, Float, Int, Space
from fide_plugins.types import Float64

yy, xx = np.mgrid[0:32, 0:32] / 31.0
SPACE = Space(
    x=Float(0, 1),
    radius=Float(0.05, 0.4, log=True),
    angle=Float(0, 360, unit="deg", periodic=True),
    columns=Int(3, 8),
    floor=Choice("plain", "across", "along"),
)
TRUTH = {"x": 0.6, "radius": 0.2, "angle": 350.0, "columns": 6, "floor": "along"}


def render(p: dict[str, Any]) -> Float64:
    where = {"plain": 0 * xx, "across": xx, "along": yy}[p["floor"]]
    ground = 0.3 + 0.2 * np.sin(np.pi * p["columns"] * where)
    inside = 1 / (1 + np.exp((np.hypot(xx - p["x"], yy - 0.5) - p["radius"]) * 60))
    shade = 0.5 + 0.5 * np.cos(np.arctan2(yy - 0.5, xx - p["x"]) - np.deg2rad(p["angle"]))
    image: Float64 = ground * (1 - inside) + inside * shade
    return image


TARGET = render(TRUTH)


def step(opt: FIDE) -> None:
    X = opt.ask()
    np.testing.assert_array_equal(SPACE.snap(X), X)  # what is asked is what is rendered
    opt.tell(X, [render(p) for p in SPACE.decode_many(X)])


def fitted(seed: int) -> FIDE:
    opt = FIDE(SPACE, TARGET, seed=seed)
    while opt.evaluations < 1200 and (opt.best is None or opt.best.loss > 1e-7):
        step(opt)
    return opt


@pytest.mark.thorough
def test_all_kinds_of_parameters_are_found() -> None:
    """By two of at most six runs: the angle lies near the end of its range."""
    found = 0
    for seed in range(6):
        best = fitted(seed).best
        assert best is not None and best.params is not None
        if (best.params["columns"], best.params["floor"]) != (6, "along"):
            continue
        if abs((best.params["angle"] - 350 + 180) % 360 - 180) < 20:
            assert best.params["radius"] == pytest.approx(0.2, rel=0.2)
            found += 1
        if found == 2:
            return
    raise AssertionError(f"{found} of six runs found the integer, the choice and the angle")


def test_what_is_found_has_names_and_a_status() -> None:
    opt = FIDE(SPACE, TARGET, seed=0)
    opt.tell(SPACE.encode(TRUTH)[None], [TARGET])
    assert opt.best is not None and opt.best.params == SPACE.decode(SPACE.encode(TRUTH))
    assert "columns" in repr(opt.best) and "array" not in repr(opt.best)
    assert opt.status.code == "solved"
    assert opt.solutions(1)[0].params == opt.best.params


def test_it_goes_on_from_a_file_bit_for_bit(tmp_path: Path) -> None:
    opt = FIDE(SPACE, TARGET, seed=1)
    for _ in range(12):
        step(opt)
    opt.save(tmp_path / "opt")
    other = FIDE.load(tmp_path / "opt")
    assert other.space == SPACE
    for _ in range(12):
        np.testing.assert_array_equal(opt.state.search.mean, other.state.search.mean)
        step(opt)
        step(other)
    assert opt.best is not None and other.best is not None
    np.testing.assert_array_equal(opt.best.x, other.best.x)


def test_a_point_that_was_never_asked_counts_as_what_is_rendered_there() -> None:
    opt = FIDE(SPACE, TARGET, seed=0)
    x = SPACE.encode(TRUTH)
    inexact = np.clip(x + 0.01 * (np.arange(len(x)) > 2), 0, 1)
    opt.tell(inexact[None], [render(SPACE.decode(inexact))])
    assert opt.best is not None
    np.testing.assert_array_equal(opt.best.x, SPACE.snap(inexact))


def test_a_space_of_numbers_is_searched_as_the_cube_to_the_bit() -> None:
    space = Space(a=Float(-1, 1), b=Float(0.1, 1, log=True), c=Float(0, 9))
    target = np.full((8, 8, 3), 0.5)
    named, plain = FIDE(space, target, seed=1), FIDE(3, target, seed=1)
    for _ in range(20):
        X = plain.ask()
        np.testing.assert_array_equal(named.ask(), X)
        images = np.tile(X.mean(axis=1)[:, None, None, None], (1, 8, 8, 3))
        named.tell(X, images)
        plain.tell(X, images)
    np.testing.assert_array_equal(named.recommend(), plain.recommend())
