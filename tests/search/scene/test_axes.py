"""Axes that are one parameter move together, and periodic ones have no walls."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.population import TrainingSample
from fide_plugins.search.mixed import Axes, Values
from fide_plugins.search.moves import (
    HalfTurn,
    Known,
)
from fide_plugins.search.scene import Exchangeability, Sensitivity
from fide_plugins.types import Float64

SPACE = Space(
    x=Float(0, 1),
    angle=Float(0, 360, periodic=True),
    floor=Choice("plain", "across", "along", "both"),
    n=Int(1, 9),
    lamp=Choice("on", "off", "dim"),
)
DIM, FLOOR, LAMP = SPACE.dim, [2, 3, 4, 5], [7, 8, 9]
HERE = SPACE.encode({"x": 0.2, "angle": 2.0, "floor": "across", "n": 3, "lamp": "dim"})
THERE = SPACE.encode({"x": 0.9, "angle": 355.0, "floor": "both", "n": 7, "lamp": "on"})


def rendered(x: Float64, loss: float = 1.0) -> TrainingSample:
    """One token a parameter shows."""
    values = SPACE.layout.numbers(x[None])[0]
    tokens = torch.as_tensor(np.repeat(values[:, None], 3, axis=1))
    return TrainingSample(0, x.copy(), tokens, loss, 0)


@pytest.fixture
def known() -> Known:
    axes = Axes(DIM, SPACE.layout)
    known = Known(
        x0=np.full(DIM, 0.5),
        sigma0=np.full(DIM, 1 / 6),
        target=rendered(THERE).tokens,
        channels=3,
        exchangeability=Exchangeability(axes, 3, []),
        sensitivity=Sensitivity(axes, 3),
        axes=axes,
        place=SPACE.snap,
    )
    known.incumbent = rendered(HERE)
    known.optima.note(known.incumbent, known.exchangeability.distance)
    known.optima.note(rendered(THERE, 2.0), known.exchangeability.distance)
    return known


def test_a_sensitivity_sample_moves_one_parameter(known: Known, rng: np.random.Generator) -> None:
    X = known.sensitivity.draw(HERE, rng)
    moved = [set(np.flatnonzero(row != HERE)) for row in X]
    assert moved == [{0}, {1}, set(FLOOR), {6}, set(LAMP)]
    for _ in range(8):
        X = SPACE.snap(known.sensitivity.draw(HERE, rng))
        known.sensitivity.learn(known.current, [rendered(x) for x in X])
    parts = [sorted(part.tolist()) for part in known.sensitivity.groups]
    assert sorted(parts) == [[0], [1], FLOOR, [6], LAMP], "each shows in a place of its own"
    saved = known.sensitivity.state_dict()
    other = Sensitivity(Axes(DIM, SPACE.layout), 3)
    other.load_state_dict(saved)
    assert [part.tolist() for part in other.groups] == [
        part.tolist() for part in known.sensitivity.groups
    ]


def test_periodic_parameters_are_near_across_the_end(known: Known) -> None:
    across = HERE.copy()
    across[1] = THERE[1]
    assert known.exchangeability.distance(HERE, across) == pytest.approx(7 / 360)
    near = rendered(across, 0.5)
    assert known.optima.note(near, known.exchangeability.distance)
    assert len(known.optima.all) == 2, "the same optimum"


def test_half_a_turn_of_a_periodic_parameter_is_exact(
    known: Known, rng: np.random.Generator
) -> None:
    known.values = Values(known.axes)
    X = HalfTurn().draw(known, 200, rng)
    np.testing.assert_array_equal(
        X[:, FLOOR + LAMP + [6]], np.tile(HERE[FLOOR + LAMP + [6]], (200, 1))
    )
    angle = X[:, 1]
    turned = ~np.isin(angle, [HERE[1], 1 - HERE[1]])
    assert turned.any() and np.allclose(angle[turned], HERE[1] + 0.5)
