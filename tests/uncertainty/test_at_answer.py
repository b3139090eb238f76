"""Standard deviations by renders around an answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fide_plugins.types import Float64
from fide_plugins.uncertainty.at_answer import deviations_at

V, U = np.mgrid[0:40, 0:40] / 39
BUMP = np.exp(-50 * ((U - 0.4) ** 2 + (V - 0.6) ** 2))
SLOPES = np.array([np.sin(12 * U + 3 * V), BUMP, np.sin(9 * V)])[..., None]
IMAGE = np.full((40, 40, 1), 0.5)
ONE = np.ones((40, 40, 1))
A = np.einsum("ahwc,bhwc->ab", SLOPES, SLOPES)


def moved(error: Float64) -> tuple[Float64, Float64]:
    """By how much least squares misses the truth (3,), and its standard deviations."""
    x = np.linalg.solve(A, np.einsum("ahwc,hwc->a", SLOPES, error))
    left = error - np.einsum("a,ahwc->hwc", x, SLOPES)
    return x, deviations_at([SLOPES], [left], [IMAGE], [ONE])


def test_with_independent_noise_it_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    expected = 0.02 * np.sqrt(np.diag(np.linalg.inv(A)))
    found = np.array([moved(0.02 * rng.standard_normal(ONE.shape))[1] for _ in range(100)])
    np.testing.assert_allclose(np.median(found, axis=0), expected, rtol=0.2)


@pytest.mark.parametrize("width", [0.0, 1.0, 2.5])
def test_the_truth_is_in_as_many_intervals_as_they_say(width: float) -> None:
    """Also where what the renderer cannot draw covers many pixels, so that few are independent."""
    rng = np.random.default_rng(0)
    errors, deviations = [], []
    for _ in range(200):
        noise = gaussian_filter(rng.standard_normal(ONE.shape), (width, width, 0), mode="wrap")
        x, std = moved(0.1 * noise)
        errors.append(x)
        deviations.append(std)
    ratio = np.abs(errors) / np.array(deviations)
    assert 0.58 <= (ratio < 1).mean() <= 0.78
    assert 0.85 <= (ratio < 1.96).mean() <= 1.0


def test_what_the_search_has_left_and_what_nothing_shows_count() -> None:
    away = np.array([0.01, 0.0, -0.02])
    left = np.einsum("a,ahwc->hwc", away, SLOPES)
    found = deviations_at([SLOPES], [left], [IMAGE], [ONE])
    assert (found[[0, 2]] >= 0.99 * np.abs(away[[0, 2]])).all() and found.max() < 0.05
    unseen = np.concatenate([SLOPES, np.zeros((1, 40, 40, 1))])
    last = deviations_at([unseen], [left], [IMAGE], [ONE])[-1]
    assert last == pytest.approx(12**-0.5, rel=1e-6)
    still = deviations_at([SLOPES], [0 * left], [IMAGE], [ONE])
    assert (still > 0).all(), "8 bits at most are told"


def test_colors_and_views_count_as_they_are() -> None:
    """Three equal colors are one, two views twice as much."""
    rng = np.random.default_rng(0)
    noise = 0.02 * rng.standard_normal(ONE.shape)
    one = deviations_at([SLOPES], [noise], [IMAGE], [ONE])
    slopes, left, image, ones = (np.repeat(each, 3, -1) for each in (SLOPES, noise, IMAGE, ONE))
    np.testing.assert_allclose(deviations_at([slopes], [left], [image], [ones]), one)
    two = deviations_at([SLOPES] * 2, [noise] * 2, [IMAGE] * 2, [ONE] * 2)
    assert (two < 1.01 * one).all()
