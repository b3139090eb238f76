"""Every integer and choice gets its turn with another value, which the search then holds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.options import Options
from fide_plugins.population import TrainingSample
from fide_plugins.search.mixed import Axes, Values
from fide_plugins.search.moves import ChangeValue, Known
from fide_plugins.search.one_search import Search, Setting
from fide_plugins.search.scene import Exchangeability, Sensitivity
from fide_plugins.types import Float64

SPACE = Space(
    x=Float(0, 1),
    floor=Choice("plain", "across", "along"),
    n=Int(3, 8),
    lamp=Choice("on", "off"),
    many=Int(1, 10_000, log=True),
    wide=Float(0, 360, step=90),
)
HERE = SPACE.snap(
    SPACE.encode({"x": 0.2, "floor": "across", "n": 4, "lamp": "on", "many": 40, "wide": 90.0})
)
AXES = Axes(SPACE.dim, SPACE.layout)


@pytest.fixture
def known() -> Known:
    known = Known(
        x0=np.full(SPACE.dim, 0.5),
        sigma0=np.full(SPACE.dim, 1 / 6),
        target=torch.zeros(1, 3),
        channels=3,
        exchangeability=Exchangeability(AXES, 3, []),
        sensitivity=Sensitivity(AXES, 3),
        axes=AXES,
        place=SPACE.snap,
        values=Values(AXES),
    )
    known.incumbent = TrainingSample(0, HERE.copy(), torch.ones(1, 3), 1.0, 0)
    return known


def changes(X: Float64) -> list[tuple[str, Any]]:
    """Name and value of the one parameter in which each point differs from HERE."""
    here = SPACE.decode(HERE)
    found = []
    for params in SPACE.decode_many(X):
        ((name, value),) = [(k, v) for k, v in params.items() if v != here[k]]
        found.append((name, value))
    return found


def test_each_parameter_gets_its_other_values_once(known: Known) -> None:
    found = changes(known.values.others(HERE))
    assert len(found) == len(set(found))
    by = {name: {v for k, v in found if k == name} for name in SPACE.names}
    assert by["x"] == set() and by["floor"] == {"plain", "along"} and by["lamp"] == {"off"}
    assert by["n"] == {3, 5, 6, 7, 8} and by["wide"] == {0.0, 180.0, 270.0, 360.0}
    assert {39, 41} <= by["many"] and min(by["many"]) < 20 and max(by["many"]) > 100


def test_each_value_is_searched_before_one_is_searched_again(known: Known) -> None:
    move, rng = ChangeValue(), np.random.default_rng(0)
    total = len(known.values.others(HERE))
    seen = []
    for _ in range(total):
        X = move.draw(known, 20, rng)
        assert 1 <= len(X) <= 20
        x = X[rng.integers(len(X))]
        seen += changes(x[None])
        move.begin_at(known, x)  # which notes it
    assert len(set(seen)) == total
    assert len(move.draw(known, 1000, rng)) == total, "all again"


def test_the_search_holds_the_value_and_nothing_else(known: Known) -> None:
    x = known.values.others(HERE)[0]  # another floor
    start = ChangeValue().begin_at(known, x)
    floor = SPACE.axes["floor"]
    assert start.fixed is not None and np.flatnonzero(start.fixed).tolist() == floor
    setting = Setting(12, known.sigma0, Options(), AXES)
    search = Search(replace(start, std=np.full(SPACE.dim, 0.5)), np.inf, setting)
    rng = np.random.default_rng(0)
    X, z = search.sample(200, rng)
    for points in (X, search.place_proposals(rng.random((200, SPACE.dim)), z)):
        np.testing.assert_array_equal(points[:, floor], np.tile(x[floor], (200, 1)))
        assert len({one["n"] for one in SPACE.decode_many(points)}) > 2
    free = search.axes.clipped(SPACE.snap(rng.random((50, SPACE.dim))))
    assert len({one["floor"] for one in SPACE.decode_many(free)}) == 3, "a user's own point"


def picture(params: dict[str, Any]) -> Float64:
    """Stripes at x, or a plain floor, below a row as bright as y; (8, 8)."""
    image = np.full((8, 8), 0.5)
    if params["floor"] == "stripes":
        image[:] = 0.5 + 0.5 * np.sin(40 * (np.arange(8) / 8 + params["x"]))
    image[0] = params["y"]
    return image
