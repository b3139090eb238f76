"""Triangles against geometry, and what the numbers of es-clip mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_tasks.triangles import _paint

SIZE = 96


def painted(*triangles: tuple[NDArray[np.float64], list[float]]) -> NDArray[np.float32]:
    """Triangles with corners (3, 2) in [0, 1], and paint: red, green, blue and opacity; on gray."""
    frame = np.empty((SIZE, SIZE, 3), np.float32)
    corners, paint = zip(*triangles, strict=True)
    _paint(frame, np.array(corners), np.array(paint, np.float32))
    return frame


def test_a_triangle_covers_what_its_corners_say() -> None:
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    for corners in np.random.default_rng(0).random((20, 3, 2)):
        (ax, ay), (bx, by), (cx, cy) = corners * SIZE
        double = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(double) < 0.02 * SIZE**2:
            continue  # slivers: see below
        # barycentric coordinates, and how far one pixel is in each
        s = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / double
        t = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / double
        least = np.min([s, t, 1 - s - t], axis=0)
        pixel = np.max([np.hypot(bx - cx, by - cy), np.hypot(cx - ax, cy - ay),
                        np.hypot(ax - bx, ay - by)]) / abs(double)  # fmt: skip
        image = 2 * painted((corners, [1.0, 1.0, 1.0, 1.0]))[:, :, 0] - 1
        np.testing.assert_allclose(image[least > pixel], 1, atol=1e-5)
        np.testing.assert_array_equal(image[least < -pixel], 0)
        assert abs(image.sum() - abs(double) / 2) < 0.03 * abs(double) / 2 + 4


def test_what_is_painted_last_is_in_front() -> None:
    place, middle = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]]), SIZE // 2
    red, blue = (place, [1.0, 0.0, 0.0, 0.5]), (place, [0.0, 0.0, 1.0, 0.5])
    seen = painted(red, blue)[middle // 2, middle]
    np.testing.assert_allclose(seen, [0.375, 0.125, 0.625], atol=1e-5)
    np.testing.assert_allclose(painted(blue, red)[middle // 2, middle], seen[::-1], atol=1e-5)


def test_only_differences_relative_to_their_range_count() -> None:
    task = fide_tasks.make("triangles", 48, triangles=10)
    x = np.random.default_rng(3).random((10, 10))
    scaled = 0.3 + 0.2 * x
    images = task.render(np.stack([x.ravel(), scaled.ravel()]))
    np.testing.assert_allclose(images[1], images[0], atol=1e-4)


def test_all_of_an_image_of_several_blocks_is_painted() -> None:
    small = fide_tasks.make("triangles", 60, triangles=5)
    large = fide_tasks.make("triangles", 240, triangles=5)
    X = np.random.default_rng(4).random((1, small.dim))
    coarse = large.render(X)[0].reshape(60, 4, 60, 4, 3).mean(axis=(1, 3))
    assert np.abs(coarse - small.render(X)[0]).mean() < 0.01
