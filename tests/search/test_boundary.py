"""Reflection at the walls of the unit cube: a change of coordinates, and its closest inverse."""

from __future__ import annotations

import numpy as np
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from fide_plugins.search import mixed
from fide_plugins.types import Float64

anywhere = hnp.arrays(np.float64, (4, 3), elements=st.floats(-1e6, 1e6))
inside = hnp.arrays(np.float64, (4, 3), elements=st.floats(0.0, 1.0))
means = hnp.arrays(np.float64, 3, elements=st.floats(-50.0, 50.0))


@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_every_candidate_stands_for_a_point_of_the_cube(z: Float64) -> None:
    x = mixed.into(z)
    assert x.shape == z.shape
    assert x.min() >= 0.0 and x.max() <= 1.0


@given(anywhere)
def test_even_and_periodic(z: Float64) -> None:
    np.testing.assert_allclose(mixed.into(-z), mixed.into(z), atol=1e-9)
    np.testing.assert_allclose(mixed.into(z + 2), mixed.into(z), atol=1e-9)
    np.testing.assert_allclose(mixed.into(2 - z), mixed.into(z), atol=1e-9)


@given(anywhere, anywhere)
def test_no_step_becomes_longer(a: Float64, b: Float64) -> None:
    assert (np.abs(mixed.into(a) - mixed.into(b)) <= np.abs(a - b) + 1e-9).all()


@given(inside, means)
def test_near_is_the_closest_of_all_images(x: Float64, mean: Float64) -> None:
    turns = 2.0 * np.arange(-30, 31)[:, None, None]
    images = np.concatenate([x + turns, -x + turns])
    closest = np.abs(images - mean).min(axis=0)
    distance = np.abs(mixed.closest(x, mean) - mean)
    np.testing.assert_allclose(distance, closest, rtol=0, atol=1e-12)
    assert (distance <= 1.0 + 1e-12).all()


def test_samples_near_a_wall_keep_their_covariance() -> None:
    """What the distribution learns from is z, half of which lies beyond the wall."""
    rng = np.random.default_rng(0)
    z = 0.1 * rng.standard_normal((10_000, 1))
    x = mixed.into(z)
    assert x.std() < 0.065  # telling the repaired points would lose a third of the spread
    np.testing.assert_allclose(np.abs(mixed.closest(x, np.zeros(1))), np.abs(z), atol=1e-12)


turning = np.array([True, False, True])


@given(anywhere)
def test_a_periodic_coordinate_wraps(z: Float64) -> None:
    x = mixed.into(z, turning)
    assert x.min() >= 0.0 and x.max() <= 1.0
    np.testing.assert_array_equal(x[:, 1], mixed.into(z)[:, 1])
    difference = np.abs(x - mixed.into(z + np.array([1, 0, -3]), turning))
    np.testing.assert_allclose(np.minimum(difference, 1 - difference)[:, [0, 2]], 0, atol=1e-9)


@given(inside, means)
def test_near_takes_the_nearest_turn(x: Float64, mean: Float64) -> None:
    z = mixed.closest(x, mean, turning)
    np.testing.assert_array_equal(z[:, 1], mixed.closest(x, mean)[:, 1])
    assert (np.abs(z - mean)[:, [0, 2]] <= 0.5 + 1e-12).all()
    difference = np.abs(mixed.into(z, turning) - x)
    np.testing.assert_allclose(np.minimum(difference, 1 - difference)[:, [0, 2]], 0, atol=1e-12)
