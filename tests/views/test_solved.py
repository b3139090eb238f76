"""Whether an image equals the target but for what no eye sees."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.types import Float32
from fide_plugins.views import Views
from fide_plugins.views.solved import is_solved

TARGET = np.full((72, 96, 3), 0.5, np.float32)  # 6,912 pixels


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


@pytest.mark.parametrize("by", [4, 10, 100])
def test_a_thing_of_3_x_3_pixels_in_a_large_picture_counts(by: float) -> None:
    large = np.full((1000, 1000, 3), 0.5, np.float32)
    views = Views.read(large)
    thing = [(500 + i, 300 + j) for i in range(3) for j in range(3)]
    assert not is_solved(views, off(by, *thing, picture=large))
    assert is_solved(views, off(by / 100, *thing, picture=large))


def test_what_a_mask_hides_does_not_count_and_each_view_does() -> None:
    mask = np.ones((72, 96), np.float32)
    mask[:, :90] = 0  # 432 pixels count: none may differ
    views = Views.read([TARGET, TARGET], [mask, None])

    def solved(first: Float32, second: Float32) -> bool:
        batch = views.as_batch([first[None], second[None]], 1, print)
        return is_solved(views, np.asarray(batch[0], np.float32))

    assert solved(off(100, (10, 10)), TARGET) and solved(TARGET, off(5, (3, 3)))
    assert not solved(TARGET, off(17, (3, 3)))
