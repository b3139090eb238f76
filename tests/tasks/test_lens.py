"""Lens: the camera against OpenCV, its inverse, and what makes the answer unique."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import lens

Array = NDArray[np.float64]


@cache
def cameras(n: int) -> Array:
    """Physical values of targets, (n, 11)."""
    tasks = [fide_tasks.make("lens", 32, seed) for seed in range(n)]
    return np.array([task._physical(task.x_star) for task in tasks if task.x_star is not None])


def board_points() -> Array:
    x, y = np.meshgrid(np.linspace(-3.5, 3.5, 8), np.linspace(-2.5, 2.5, 6))
    return np.stack([x.ravel(), y.ravel(), np.zeros(48)], axis=1)


def test_points_are_seen_where_opencv_sees_them() -> None:
    points = board_points()
    for v in cameras(4):
        rotation, _ = cv2.Rodrigues(lens.rotation(v))
        camera = np.diag([v[6], v[6], 1.0])
        seen, _ = cv2.projectPoints(points, rotation, v[3:6], camera, v[7:])
        np.testing.assert_allclose(lens.project(v, points), seen[:, 0], atol=1e-9)


def test_the_inverse_finds_the_points_of_the_board_again() -> None:
    """To 0.02 squares for points in the picture; iterations stop before rounding does."""
    points = board_points()
    for v in cameras(4):
        x, y = lens.project(v, points).T.astype(np.float32)
        inside = np.maximum(np.abs(x), np.abs(y)) < 0.5
        assert inside.sum() >= 40
        u, w, _, seen = lens.on_board(v, x[inside], y[inside])
        assert seen.all()
        np.testing.assert_allclose(u, points[inside, 0], atol=0.02)
        np.testing.assert_allclose(w, points[inside, 1], atol=0.02)
