"""Search spaces as unit cubes (acceptance point 11)."""

from __future__ import annotations

from typing import Any

import numpy as np
import optuna
import pytest
from hypothesis import given, settings, strategies as st
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from fide_adapters.optuna.search_space import SearchSpace as Space
from fide_plugins.errors import SpaceError

SPACE: dict[str, BaseDistribution] = {
    "float": FloatDistribution(-2.0, 5.0),
    "log": FloatDistribution(1e-7, 10.0, log=True),
    "far": FloatDistribution(1e9, 1e9 + 1),
    "step": FloatDistribution(-10.2, 10.2, step=0.1),
    "int": IntDistribution(-3, 4),
    "int step": IntDistribution(0, 10, step=5),
    "int log": IntDistribution(1, 100, log=True),
    "choice": CategoricalDistribution(["a", "b", None, 1.5]),
    "switch": CategoricalDistribution([True, False]),
}
DIM = 7 + 4 + 1
points = st.lists(st.floats(0.0, 1.0), min_size=DIM, max_size=DIM).map(np.array)


def frozen(params: dict[str, Any], space: dict[str, BaseDistribution]) -> optuna.trial.FrozenTrial:
    return optuna.trial.create_trial(params=params, distributions=space, value=0.0)


@given(points)
@settings(max_examples=60, deadline=None)
def test_point_11_every_point_is_a_choice_of_native_values(x: Any) -> None:
    space = Space(SPACE)
    params = space.decode(x)
    for name, distribution in SPACE.items():
        assert distribution._contains(distribution.to_internal_repr(params[name]))
        if isinstance(distribution, FloatDistribution):
            assert type(params[name]) is float
        elif isinstance(distribution, IntDistribution):
            assert type(params[name]) is int
    assert space.holds(frozen(params, SPACE))
    again = space.encode(params)
    assert again.min() >= 0.0 and again.max() <= 1.0
    np.testing.assert_array_equal(space.snap(x), again)
    for name, value in space.decode(again).items():
        same = value == params[name]
        assert same if type(value) is not float else value == pytest.approx(params[name], rel=1e-12)


FOREIGN: dict[str, tuple[dict[str, Any], dict[str, BaseDistribution]]] = {
    "absent": ({}, {}),
    "out of range": ({"x": 7.0}, {"x": FloatDistribution(0, 10)}),
    "another kind": ({"x": 3}, {"x": IntDistribution(0, 5)}),
    "choices": ({"x": "a"}, {"x": CategoricalDistribution(["a", "b"])}),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_trials_of_another_space_are_left_out(what: str) -> None:
    params, distributions = FOREIGN[what]
    assert not Space({"x": FloatDistribution(0, 5)}).holds(frozen(params, distributions))


@pytest.mark.filterwarnings("ignore:Choices for a categorical distribution")
def test_a_choice_of_nan_is_any_nan() -> None:
    mine, other = (CategoricalDistribution([float("nan"), "b"]) for _ in range(2))
    space = Space({"x": mine})
    for value in (float("nan"), "b"):
        trial = frozen({"x": value}, {"x": other})
        assert space.holds(trial)
        assert space.decode(space.encode(trial.params))["x"] in (mine.choices[0], "b")


def test_a_range_that_is_too_long_is_refused() -> None:
    endless = {"a": SPACE["int"], "b": FloatDistribution(-1.7e308, 1.7e308)}
    with pytest.raises(SpaceError, match="parameter 'b'.*high - low must be finite; take a narrow"):
        Space(endless)


def test_trials_with_more_or_in_a_wider_range_are_taken() -> None:
    trial = frozen({"x": 3.0, "y": 1}, {"x": FloatDistribution(0, 9), "y": IntDistribution(0, 1)})
    assert Space({"x": FloatDistribution(0, 5)}).holds(trial)
    choice = frozen({"x": "z"}, {"x": CategoricalDistribution(["a", "z"])})
    assert not Space({"x": CategoricalDistribution(["a", "b"])}).holds(choice)
