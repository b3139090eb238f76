"""Medians of 3 x 3 pixels, but not of small images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from fide_plugins.encoders.despeckle import SMALLEST, despeckled

RNG = np.random.default_rng(16)


def test_it_is_the_median_of_each_color() -> None:
    image = RNG.random((90, 101, 3), dtype=np.float32)
    before = image.copy()
    expected = median_filter(image, size=(3, 3, 1), mode="nearest")
    np.testing.assert_array_equal(despeckled(image), expected)
    np.testing.assert_array_equal(despeckled(image[::-1, ::-1]), expected[::-1, ::-1])
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(
    ("size", "changed"),
    [((SMALLEST, SMALLEST), True), ((SMALLEST, SMALLEST - 1), False), ((1, 9000), True)],
)
def test_small_images_are_left_alone(size: tuple[int, int], changed: bool) -> None:
    image = RNG.random((*size, 3), dtype=np.float32)
    assert np.array_equal(despeckled(image), image) != changed


def step(size: int) -> NDArray[np.float32]:
    image = np.full((size, size, 3), 0.2, np.float32)
    image[:, size // 3 :] = 0.8
    image[40:42, 50:90] = 0.5  # a line of two pixels
    return image


def test_edges_and_lines_of_two_pixels_stay() -> None:
    image = step(100)
    changed = np.any(despeckled(image) != image, axis=2)
    assert changed.sum() <= 4  # corners, at the ends of the line
    image[7, 20] = image[60, 80] = 1.0
    image[70, 30] = (0.0, 1.0, 0.5)
    np.testing.assert_array_equal(despeckled(image), despeckled(step(100)))
