"""Maps of a search over integers, choices and angles, and a search by them."""

from __future__ import annotations

import numpy as np

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.mixed import Mixed, closest, into
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
    z, mean = rng.normal(0.5, 1, (20, 2)), rng.random(2)
    x = into(z)
    mixed = Mixed(NUMBERS.layout)
    np.testing.assert_array_equal(mixed.stretched(z, mean), z)
    np.testing.assert_array_equal(mixed.reflected(z), x)
    np.testing.assert_array_equal(mixed.closest(x, mean), closest(x, mean))
    np.testing.assert_array_equal(mixed.clipped(z), np.clip(z, 0, 1))
    std = np.array([1 / 6, 0.01])
    np.testing.assert_array_equal(mixed.widened(std), std)
    search = CMAES(mean, 0.3, 6)
    mixed.correct(search)
    np.testing.assert_array_equal(search.mean, mean)


def test_samples_are_snapped_and_ends_reach_to_infinity() -> None:
    mixed = Mixed(SPACE.layout)
    z = np.array([[1.25, 1.25, 1.25, -0.2, -0.3, -0.4, -5.0]])
    np.testing.assert_allclose(mixed.reflected(z), [[0.75, 0.25, 0.95, 0.75, 0.25, 0.25, 0.25]])


def shifted(space: Space, x: Float64) -> Float64:
    """Loss (n,) of a sphere whose best integer is 7 and best value "z", which share no slope."""
    losses = []
    for p in space.decode_many(x):
        angle = min(abs(p["angle"] - 350), 360 - abs(p["angle"] - 350)) / 360
        losses.append((p["a"] - 0.4) ** 2 + angle**2 + 0.02 * (p["n"] - 7) ** 2)
        losses[-1] += {"x": 0.1, "y": 0.2, "z": 0.0}[p["b"]] + 0.1 * p["s"]
    return np.array(losses)


def minimum(seed: int, *, margin: bool) -> tuple[float, Mixed, CMAES]:
    """Loss after 150 generations, beginning narrow around a wrong integer and wrong values."""
    rng, mixed = np.random.default_rng(seed), Mixed(SPACE.layout)
    start = SPACE.encode({"a": -0.5, "angle": 30, "n": 1, "b": "y", "s": 1})
    search = CMAES(start, 0.05, 9)
    for _ in range(150):
        z = search.sample(9, rng)
        losses = shifted(SPACE, mixed.reflected(mixed.stretched(z, search.mean)))
        search.tell(z, losses, np.zeros(9, bool))
        if margin:
            mixed.correct(search)
    best = mixed.reflected(search.mean[None])
    return float(shifted(SPACE, best)[0]), mixed, search


def test_a_narrow_search_finds_integer_and_choice_by_the_margin_only() -> None:
    with_margin = [minimum(seed, margin=True)[0] for seed in range(10)]
    without = [minimum(seed, margin=False)[0] for seed in range(4)]
    assert sum(loss < 1e-4 for loss in with_margin) >= 9
    assert sum(loss < 1e-4 for loss in without) <= 1
