"""Maps of a search over integers, choices and angles, and a search by them."""

from __future__ import annotations

import numpy as np

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.mixed import Axes, into
from fide_plugins.types import Float64

SPACE = Space(
    a=Float(-1, 1),
    angle=Float(0, 360, periodic=True),
    n=Int(0, 9),
    b=Choice("x", "y", "z"),
    s=Int(0, 1),
)
NUMBERS = Space(a=Float(-1, 1), b=Float(0, 1))


def test_without_cells_it_is_the_boundary_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    z = rng.normal(0.5, 1, (20, 2))
    x = into(z)
    axes = Axes(2, NUMBERS.layout)
    assert axes.discrete is None
    np.testing.assert_array_equal(axes.reflected(z), x)
    np.testing.assert_array_equal(axes.clipped(z), np.clip(z, 0, 1))
    std = np.array([1 / 6, 0.01])
    np.testing.assert_array_equal(axes.widened(std), std)


def test_samples_are_snapped_and_ends_reach_to_infinity() -> None:
    axes = Axes(SPACE.dim, SPACE.layout)
    z = np.array([[1.25, 1.25, 1.25, -0.2, -0.3, -0.4, -5.0]])
    np.testing.assert_allclose(axes.reflected(z), [[0.75, 0.25, 0.95, 0.75, 0.25, 0.25, 0.25]])


def shifted(space: Space, x: Float64) -> Float64:
    """Loss (n,) of a sphere whose best integer is 7 and best value "z", which share no slope."""
    losses = []
    for p in space.decode_many(x):
        angle = min(abs(p["angle"] - 350), 360 - abs(p["angle"] - 350)) / 360
        losses.append((p["a"] - 0.4) ** 2 + angle**2 + 0.02 * (p["n"] - 7) ** 2)
        losses[-1] += {"x": 0.1, "y": 0.2, "z": 0.0}[p["b"]] + 0.1 * p["s"]
    return np.array(losses)


def minimum(seed: int, *, margin: bool) -> float:
    """Loss after 150 generations, beginning narrow around a wrong integer and wrong values."""
    rng, axes = np.random.default_rng(seed), Axes(SPACE.dim, SPACE.layout)
    stretch: Float64 = np.ones(SPACE.dim)
    start = SPACE.encode({"a": -0.5, "angle": 30, "n": 1, "b": "y", "s": 1})
    search = CMAES(start, 0.05, 9)
    for _ in range(150):
        z = search.sample(9, rng)
        losses = shifted(SPACE, axes.reflected(search.mean + stretch * (z - search.mean)))
        search.tell(z, losses, np.zeros(9, bool))
        if margin:
            stretch = axes.correct(search, stretch)
    best = axes.reflected(search.mean[None])
    return float(shifted(SPACE, best)[0])


def test_a_narrow_search_finds_integer_and_choice_by_the_margin_only() -> None:
    with_margin = [minimum(seed, margin=True) for seed in range(10)]
    without = [minimum(seed, margin=False) for seed in range(4)]
    assert sum(loss < 1e-4 for loss in with_margin) >= 9
    assert sum(loss < 1e-4 for loss in without) <= 1
