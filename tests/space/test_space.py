"""Named parameters and the unit cube: the map, its inverse, and what users may get wrong."""

from __future__ import annotations

import copy
import json
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from fide_plugins import Choice, Float, Group, Int, Space
from fide_plugins.errors import FideError, PointsError, SpaceError
from fide_plugins.space import Kind
from fide_plugins.types import Float64

ends = st.floats(-1e6, 1e6)
floats = st.builds(
    lambda low, width, periodic: Float(low, low + width, periodic=periodic),
    ends, st.floats(1e-3, 1e6), st.booleans(),
)  # fmt: skip
logs = st.builds(
    lambda low, f: Float(low, low * f, log=True), st.floats(1e-6, 1e6), st.floats(1.1, 1e9)
)
steps = st.builds(
    lambda low, step, n: Float(low, low + n * step, step=step),
    st.floats(-100, 100), st.floats(0.01, 10), st.integers(1, 50),
)  # fmt: skip
ints = st.builds(
    lambda low, n, step: Int(low, low + n * step, step=step),
    st.integers(-(10**6), 10**6), st.integers(1, 10**6), st.integers(1, 5),
)  # fmt: skip
log_ints = st.builds(
    lambda low, n: Int(low, low + n, log=True), st.integers(1, 1000), st.integers(1, 10**6)
)
choices = st.lists(
    st.one_of(st.integers(2, 99), st.text(max_size=3), st.none(), st.booleans()),
    min_size=1, max_size=6, unique=True,
).map(lambda values: Choice(*values))  # fmt: skip
kinds = st.one_of(floats, logs, steps, ints, log_ints, choices)
groups = st.dictionaries(st.sampled_from("abc"), kinds, min_size=1).map(Group)
members = st.one_of(kinds, groups, st.builds(lambda g, n: n * g, groups, st.integers(1, 3)))
spaces = st.builds(
    lambda some, last: Space({**some, "z": last}),
    st.dictionaries(st.sampled_from("efgh"), members), floats,
)  # fmt: skip


def point(space: Space, seed: int) -> Float64:
    """A point of the cube, now and then on its walls."""
    rng = np.random.default_rng(seed)
    return np.clip(rng.uniform(-0.1, 1.1, space.dim), 0, 1)


def same(a: Any, b: Any) -> bool:
    """Equal, but for the rounding of floats."""
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float):
        return isinstance(b, float) and bool(np.isclose(a, b, rtol=1e-9, atol=1e-6))
    return type(a) is type(b) and bool(a == b)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(spaces, st.integers(0, 2**32))
def test_round_trips(space: Space, seed: int) -> None:
    x = point(space, seed)
    params = space.decode(x)
    snapped = space.snap(x)
    np.testing.assert_allclose(space.encode(params), snapped, rtol=0, atol=1e-6)
    assert same(space.decode(space.encode(params)), params)
    assert space.decode(snapped) == params
    np.testing.assert_array_equal(space.snap(snapped), snapped)
    assert ((snapped >= 0) & (snapped <= 1)).all()
    continuous = ~space.layout.discrete
    np.testing.assert_array_equal(snapped[continuous], x[continuous])


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(spaces)
def test_a_space_is_a_value(space: Space) -> None:
    data = json.loads(json.dumps(space.to_dict()))
    again = Space.from_dict(data)
    assert again == space and hash(again) == hash(space) and again.to_dict() == space.to_dict()
    assert eval(
        repr(space._members), {"Float": Float, "Int": Int, "Choice": Choice, "Group": Group}
    ) == (space._members)  # every kind is shown as the expression that makes it
    assert pickle.loads(pickle.dumps(space)) == space == copy.deepcopy(space)


def test_the_example(space: Space) -> None:
    assert space.dim == 1 + 1 + 1 + 3 + 1 + 1 + 1 + 6
    assert space.names == [
        "azimuth", "roughness", "columns", "floor", "shadows", "light.power", "light.place.x",
        "beads[0].x", "beads[0].y", "beads[1].x", "beads[1].y", "beads[2].x", "beads[2].y",
    ]  # fmt: skip
    assert space.axes["floor"] == [3, 4, 5] and space.axes["beads[1].y"] == [12]
    assert space.groups == [[9, 10], [11, 12], [13, 14]] and space.families == {
        "beads": space.groups
    }
    np.testing.assert_array_equal(space.periodic, [True] + 14 * [False])
    middle = space.decode(np.full(space.dim, 0.5))
    assert middle == {
        "azimuth": 0.0, "roughness": pytest.approx(0.02), "columns": 6, "floor": "checker",
        "shadows": True, "light": {"power": 22, "place": {"x": 1.0}},
        "beads": 3 * [{"x": 0.5, "y": 0.5}],
    }  # fmt: skip
    assert (
        repr(space) == "Space(azimuth, roughness, columns, floor, shadows, light, beads[3]; dim 15)"
    )
    assert [type(v) for v in middle.values()] == [float, float, int, str, bool, dict, list]


def test_the_ends_are_the_bounds(space: Space) -> None:
    low, high = space.decode(np.zeros(space.dim)), space.decode(np.ones(space.dim))
    assert (low["azimuth"], low["roughness"], low["columns"]) == (-60.0, 0.002, 3)
    assert (high["azimuth"], high["roughness"], high["columns"]) == (60.0, 0.2, 8)
    assert (low["light"], high["light"]) == (
        {"power": 1, "place": {"x": 0.0}}, {"power": 1000, "place": {"x": 2.0}},
    )  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [
        Int(3, 8), Float(0, 1, step=0.25), Choice("a", "b"), Int(-9, 9, step=3),
        Int(2**40 - 5, 2**40), Int(-(2**40), 6 - 2**40, step=3),
    ],
)  # fmt: skip
def test_cells_are_equal(kind: Kind) -> None:
    space = Space(v=kind)
    x = (np.arange(6000) + 0.5) / 6000
    values = [params["v"] for params in space.decode_many(x[:, None])]
    counts = [values.count(value) for value in sorted(set(values))]
    assert max(counts) - min(counts) <= 1
    lower, upper = space.layout.cells(np.array([0.01]))
    assert lower[0] == -np.inf and upper[0] == pytest.approx(1 / len(counts), abs=1e-12)


@pytest.mark.parametrize(
    ("low", "high", "step"),
    [
        (1.7e9, 1.8e9, 0.001), (1.7e9 + 0.1, 1.7e9 + 0.7, 0.1), (-1.8e9, -1.7e9, 1e-3),
        (1e15, 1e15 + 7, 7), (1e15, 1e15 + 14, 2), (0.1, 0.7, 0.1),
        (1e6 + 1 / 3, 1e6 + 16 / 3, 1 / 7e4),
    ],
)  # fmt: skip
def test_steps_far_from_zero(low: float, high: float, step: float) -> None:
    """Seconds since 1970 in milliseconds: doubles there hold no more than four digits of a step."""
    space = Space(t=Float(low, high, step=step))
    assert space.parameters["t"].scale.high == pytest.approx(high, abs=step / 10)
    X = np.random.default_rng(0).random((2000, 1))
    values = space.decode_many(X)
    points = space.encode_many(values)
    np.testing.assert_allclose(points, space.snap(X), atol=1e-9)
    assert space.decode_many(points) == values
    if high - low > 2 * step:
        with pytest.raises(SpaceError, match="must be a value of"):
            space.encode({"t": low + 1.3 * step})


def test_the_largest_logarithms_of_integers_are_told_apart() -> None:
    high = 2**44
    space = Space(n=Int(high - 9, high, log=True))
    values = [{"n": value} for value in range(high - 9, high + 1)]
    points = space.encode_many(values)
    assert space.decode_many(points) == values
    lower, upper = np.array([space.layout.cells(x) for x in points])[..., 0].T
    np.testing.assert_array_equal(lower[1:], upper[:-1])
    assert ((lower < points[:, 0]) & (points[:, 0] < upper)).all()


def test_cells_of_a_logarithm_are_where_the_value_changes() -> None:
    space = Space(v=Int(1, 50, log=True))
    for value in (1, 2, 7, 50):
        x = space.encode({"v": value})
        lower, upper = space.layout.cells(x)
        for edge, neighbor in ((lower[0], value - 1), (upper[0], value + 1)):
            if np.isfinite(edge):
                inside, outside = np.sign(x[0] - edge) * 1e-9, -np.sign(x[0] - edge) * 1e-9
                assert space.decode([edge + inside])["v"] == value
                assert space.decode([edge + outside])["v"] == neighbor
        if 1 < value < 50:
            assert x[0] == pytest.approx((lower[0] + upper[0]) / 2, abs=1e-12)


def test_the_largest_coordinate_chooses() -> None:
    space = Space(floor=Choice("checker", "wood", "stone"))
    assert space.decode([0.2, 0.3, 0.1]) == {"floor": "wood"}
    np.testing.assert_array_equal(space.snap([0.2, 0.3, 0.1]), [0.25, 0.75, 0.25])
    np.testing.assert_array_equal(space.encode({"floor": "stone"}), [0.25, 0.25, 0.75])


def test_many_at_once(space: Space) -> None:
    X = np.random.default_rng(0).random((20, space.dim))
    many = space.decode_many(X)
    assert many == [space.decode(x) for x in X]
    np.testing.assert_array_equal(space.encode_many(many), [space.encode(p) for p in many])
    np.testing.assert_array_equal(space.snap(X), [space.snap(x) for x in X])
    assert space.decode_many(np.empty((0, space.dim))) == []
    assert space.encode_many([]).shape == (0, space.dim)


def test_order_kind_and_bounds_make_a_space() -> None:
    a, b = Float(0, 1), Int(0, 1)
    assert Space(a=a, b=b) != Space(b=b, a=a)
    assert Space(a=a) != Space(a=Float(0, 1, unit="m")) and Space(a=a) != Space(b=a)
    assert Choice(0, 1) != Choice(False, True) and Choice(1, 2) == Choice(1, 2)
    assert Space({"a": a}, b=b) == Space(a=a, b=b)
    assert 2 * Group(a=a) == Group(a=a) * 2 != 3 * Group(a=a)
    other: Any = "a"
    assert Space(a=a) != other


def test_nothing_changes(space: Space) -> None:
    for thing, name in ((space, "dim"), (Float(0, 1), "low"), (Group(a=Int(0, 1)), "members")):
        with pytest.raises(AttributeError):
            setattr(thing, name, 3)
    space.periodic[:] = False
    space.parameters.clear()
    assert space.periodic[0] and space.parameters["columns"] == Int(3, 8)


BAD_KINDS = [
    (lambda: Float(3, 1), r"Float\(3.0, 1.0\): low must be less than high; swap them"),
    (lambda: Float(0, 1, log=True), r"log=True\): the logarithm needs low > 0"),
    (lambda: Float(1e300, float(np.nextafter(1e300, np.inf)), log=True), "ends that differ in it"),
    (lambda: Float(float("nan"), 1), "low must be a finite number, not nan"),
    (lambda: Float(-1.7e308, 1.7e308), "high - low .* must be finite"),
    (lambda: Float(False, True), "low must be a finite number, not False"),
    (lambda: Float(0, 1, unit=3), "unit must be a text"),  # type: ignore[arg-type]
    (lambda: Float(0, 1, log=1), "log must be true or false"),  # type: ignore[arg-type]
    (lambda: Float(0, 1, periodic="no"), "periodic must be true"),  # type: ignore[arg-type]
    (lambda: Float(1, 2, log=True, periodic=True), "do not go together; drop all but one"),
    (lambda: Float(0, 1, step=0), r"step must lie in \(0, high - low\]"),
    (lambda: Float(0, 1, step=2), r"step must lie in \(0, high - low\]"),
    (lambda: Float(0, 1, step=1e-15), r"at most 2\^40 values"),
    (lambda: Float(1.7e9, 1.7e9 + 1, step=1e-6), "doubles are apart there; take a wider step"),
    (lambda: Int(0, 1.5), "high must be a whole number .*, not 1.5"),  # type: ignore[arg-type]
    (lambda: Int(0, 2**60), r"at most 2\^44"),
    (lambda: Int(0, 2**41), r"at most 2\^40 values"),
    (lambda: Int(1, 9, step=2, log=True), "needs step 1, not 2; drop one"),
    (lambda: Choice(), "Choice needs 1 to 1000 values, not 0"),
    (lambda: Choice("a", ["b"]), "Choice takes values one by one, .*unhashable"),  # type: ignore[arg-type]
    (lambda: Choice(1, True), r"must differ, .* not \(1, True\); drop one"),
    (lambda: Choice(1.0, float("nan")), "must differ, and equal themselves"),
    (lambda: 0 * Group(x=Float(0, 1)), "repeated 1 to 100000 times, not 0"),
    (lambda: Group(x=Float(0, 1)) * 1.5, "not 1.5"),  # type: ignore[operator]
    (lambda: 2 * Group(a=2 * Group(x=Float(0, 1))), "cannot hold another repeated Group"),
    (lambda: Group(), "Group needs at least one parameter"),
    (lambda: Group(repeat=Float(0, 1)), "'repeat'.*; call it repeat_"),
    (lambda: Space(a=Choice("only")), "needs a parameter that can vary"),
    (lambda: Space({"bead size": Float(0, 1)}), "must be an identifier .*not 'bead size'"),
    (lambda: Space({3: Float(0, 1)}), "must be an identifier .*, not 3"),  # type: ignore[dict-item]
    (lambda: Space({"a": Int(0, 1)}, a=Int(0, 1)), r"each of them once, not \['a', 'a'\]"),
    (lambda: Space(a=(0, 1)), r"'a' must be a Float, .* not \(0, 1\)"),  # type: ignore[arg-type]
    (lambda: Space(3), "Space takes names"),  # type: ignore[arg-type]
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), BAD_KINDS)
def test_a_bad_definition_says_what_is_wrong(make: Any, message: str) -> None:
    with pytest.raises(SpaceError, match=message) as caught:
        make()
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, FideError)


BAD_PARAMS: list[tuple[Any, str]] = [
    ({"azimuth": 61}, r"parameter 'azimuth' must be a value of Float\(-60.*, not 61; change"),
    ({"azimuth": True}, "'azimuth' must be a value of"),
    ({"azimuth": float("nan")}, "'azimuth' must be a value of"),
    ({"columns": 3.5}, r"'columns' must be a value of Int\(3, 8\), not 3.5"),
    ({"columns": 10**400}, "'columns' must be a value of"),
    ({"floor": "glass"}, "'floor' must be one of 'checker', 'wood', 'stone', not 'glass'"),
    ({"floor": ["wood"]}, "'floor' must be one of"),
    ({"light": {"power": 1, "place": {"x": 0.3}}}, "'light.place.x' must be a value of"),
    ({"light": {"power": 1}}, "missing parameter 'light.place'"),
    ({"light": 3}, "'light' must be a dictionary with the keys power, place, not 3"),
    ({"flor": "wood"}, "unknown parameter 'flor'; .*did you mean 'floor'?"),
    ({"beads": [{"x": 0, "y": 0}]}, r"'beads' must be a list of 3 dictionaries, not \["),
    ({"beads": 2 * [{"x": 0, "y": 0}] + [{"x": 0, "z": 0}]}, r"unknown parameter 'beads\[2\].z'"),
]


@pytest.mark.parametrize(("change", "message"), BAD_PARAMS)
def test_bad_values_say_which_and_why(space: Space, change: Any, message: str) -> None:
    good = space.decode(np.full(space.dim, 0.5))
    with pytest.raises(SpaceError, match=message):
        space.encode({**good, **change})


def test_missing_names_are_listed(space: Space) -> None:
    good = space.decode(np.full(space.dim, 0.5))
    del good["azimuth"], good["floor"]
    with pytest.raises(SpaceError, match="missing parameter 'azimuth', 'floor'; give a value"):
        space.encode(good)
    with pytest.raises(SpaceError, match="params must be a dictionary"):
        space.encode(None)  # type: ignore[arg-type]


@pytest.mark.parametrize("x", [[0.5], np.full(15, 1.5), np.full(15, np.nan), "abc"])
def test_points_outside_of_the_cube_are_refused(space: Space, x: Any) -> None:
    for method in (space.decode, space.snap):
        with pytest.raises(PointsError):
            method(x)


def test_numbers_of_numpy_are_numbers(space: Space) -> None:
    params = space.decode(np.full(space.dim, 0.5))
    params.update(azimuth=np.float32(0.0), columns=np.int64(6))
    assert same(space.decode(space.encode(params)), space.decode(np.full(space.dim, 0.5)))
    three: Any = np.int8(3)
    assert Int(three, 8) == Int(3, 8) and type(Int(three, 8).low) is int
