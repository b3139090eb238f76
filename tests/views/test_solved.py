"""Whether an image equals the target but for what no eye sees."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.types import Float32
from fide_plugins.views import Views
from fide_plugins.views.findings import is_solved

TARGET = np.full((72, 96, 3), 0.5, np.float32)  # 6,912 pixels
V, U = np.mgrid[0:64, 0:64] / 63


def off(by: float, *where: tuple[int, int], picture: Float32 = TARGET) -> Float32:
    """The picture with pixels that are off by so many steps of 8 bits."""
    image = picture.copy()
    for row, column in where:
        image[row, column] += np.float32(by / 255)
    return image


def test_two_antialiased_pixels_do_not_count() -> None:
    views = Views.read(TARGET)
    assert is_solved(views, off(10, (10, 10), (40, 41)))
    assert is_solved(views, off(10, (10, 10), (10, 11)))
    assert is_solved(views, off(0.99, *[(i, i) for i in range(72)]))


@pytest.mark.parametrize(
    ("by", "where"),
    [
        (17, [(10, 10)]),  # by too much
        (3, [(8 * i, j) for i in range(2) for j in range(0, 96, 24)]),  # 8 of 6,912, too many
        (5, [(10, 10), (10, 11), (10, 12)]),  # together
    ],
)
def test_more_counts(by: float, where: list[tuple[int, int]]) -> None:
    views = Views.read(TARGET)
    assert views.squared_error(off(by, *where)) < (1 / 255) ** 2 / 12, "the mean is no reason"
    assert not is_solved(views, off(by, *where))


def test_what_a_mask_hides_does_not_count_and_each_view_does() -> None:
    mask = np.ones((72, 96), np.float32)
    mask[:, :90] = 0  # 432 pixels count: none may differ
    views = Views.read([TARGET, TARGET], [mask, None])

    def solved(first: Float32, second: Float32) -> bool:
        batch = views.as_batch([first[None], second[None]], 1, print)
        return is_solved(views, np.asarray(batch[0], np.float32))

    assert solved(off(100, (10, 10)), TARGET) and solved(TARGET, off(5, (3, 3)))
    assert not solved(TARGET, off(17, (3, 3)))


def disk(x: float, low: float, high: float) -> Float32:
    """A soft disk (64, 64, 3) of these colors."""
    share = 1 / (1 + np.exp(30 * (np.hypot(U - x, V - 0.35) - 0.2)))
    return np.repeat((low + (high - low) * share)[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("contrast", [0.002, 0.01, 0.05, 0.9])
@pytest.mark.parametrize("low", [0.0, 0.05])
def test_a_faint_picture_counts_as_much_as_a_strong_one(contrast: float, low: float) -> None:
    """What differs by so much of the contrast, whatever the contrast is."""
    views = Views.read(disk(0.7, low, low + contrast))
    assert is_solved(views, disk(0.7002, low, low + contrast))
    assert not is_solved(views, disk(0.71, low, low + contrast))
    assert not is_solved(views, disk(0.7, low, low + 0.98 * contrast))
    assert not is_solved(views, np.full_like(views.target, low)), "nothing is there"


def test_contrast_is_that_of_each_view_and_of_what_a_mask_shows() -> None:
    mask = np.ones((64, 64), np.float32)
    mask[:, :9] = 0
    faint = disk(0.7, 0.5, 0.504)
    faint[:, :9] = 1.0
    colored = faint + np.array([0, -0.2, -0.4], np.float32)  # so are its colors: no contrast
    views = Views.read([colored, disk(0.3, 0.1, 0.9)], [mask, None])

    def solved(x: float) -> bool:
        images = [disk(x, 0.5, 0.504) + np.array([0, -0.2, -0.4], np.float32), disk(0.3, 0.1, 0.9)]
        batch = views.as_batch([one[None] for one in images], 1, lambda _: None)
        return is_solved(views, np.asarray(batch[0], np.float32))

    assert solved(0.7) and not solved(0.71)


@pytest.mark.parametrize("levels", [255, 65535])
@pytest.mark.parametrize("range_of_values", [1.0, 100 / 255])
def test_a_perfect_image_of_a_rounded_picture_equals_it(
    levels: int, range_of_values: float
) -> None:
    """Of a flat area all values are rounded alike, by up to half a step."""
    kind = np.uint8 if levels == 255 else np.uint16
    for low in np.linspace(0.05, 0.1, 12):
        exact = np.float32(range_of_values) * disk(0.7, low, 0.9)
        rounded = np.round(exact * levels).astype(kind)
        views = Views.read(rounded, value_range=(0, levels))
        assert is_solved(views, exact)
        assert not is_solved(views, np.float32(range_of_values) * disk(0.72, low, 0.9))
