"""The choice of a view, in worlds so simple that what they show is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_tasks.viewpoints import axes, merit

Array = NDArray[np.float64]
LOW = np.array([7.0, 1, -2, 45, 0, 7, 1, -2])
HIGH = np.array([25.0, 10, 12, 135, 360, 25, 10, 12])


def nothing(origins: Array, directions: Array) -> tuple[Array, Array]:
    return np.full(len(origins), np.inf), np.zeros_like(directions)


def ground(origins: Array, directions: Array) -> tuple[Array, Array]:
    """The plane y = 0."""
    with np.errstate(divide="ignore"):
        t = -origins[:, 1] / directions[:, 1]
    return np.where(t > 0, t, np.inf), np.tile([0.0, 1.0, 0.0], (len(t), 1))


def room(origins: Array, directions: Array) -> tuple[Array, Array]:
    """The inside of a box around the camera's, one meter away from it."""
    walls = np.stack([LOW[:3] - 1, HIGH[:3] + 1])[(directions > 0).astype(int), np.arange(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (walls - origins) / directions
    wall = np.nan_to_num(t, nan=np.inf).argmin(axis=1)
    return t[np.arange(len(t)), wall], -np.eye(3)[wall] * np.sign(directions)


@pytest.mark.parametrize("theta", [0.0, 1.0, 60.0, 90.0, 179.0, 180.0])
@pytest.mark.parametrize("phi", [0.0, 45.0, 180.0, 300.0, 360.0])
def test_axes_are_those_of_a_camera_held_level(theta: float, phi: float) -> None:
    right, up, forward = axes(theta, phi)
    np.testing.assert_allclose(
        np.stack([right, up, forward]) @ np.stack([right, up, forward]).T, np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(np.cross(forward, up), right, atol=1e-12)
    t, p = np.radians([theta, phi])
    np.testing.assert_allclose(
        forward, [np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], atol=1e-12
    )
    assert right[1] == 0
    assert up[1] > -1e-12


def test_merit_of_an_empty_world_and_of_the_ground() -> None:
    level = np.array([16.0, 5, 5, 90, 0, 18, 5, 5])
    empty = merit(level, nothing, 60)
    assert (empty.sky, empty.close, empty.far, empty.edges, empty.lit) == (1, 0, 0, 0, 0)
    half = merit(level, ground, 60)
    assert half.sky == 0.5, "everything above the horizon"
    assert half.far == 0.5
    down = merit(np.array([16.0, 1, 5, 180, 0, 16, 2, 5]), ground, 60)
    assert (down.sky, down.close, down.lit, down.blinding) == (0, 1, 1, 1)
    hidden = merit(np.array([16.0, 1, 5, 180, 0, 16, -2, 5]), ground, 60)
    assert hidden.lit == 0, "the light is under the ground"


def test_shadows_are_seen() -> None:
    def roofed(origins: Array, directions: Array) -> tuple[Array, Array]:
        t, normal = ground(origins, directions)
        with np.errstate(divide="ignore"):
            up = (3.0 - origins[:, 1]) / directions[:, 1]
        blocked = (up > 0) & (up < t)
        return np.where(blocked, up, t), np.where(blocked[:, None], [0.0, -1.0, 0.0], normal)

    v = np.array([16.0, 1.5, 5, 150, 0, 16, 2.5, 5])
    above = v + np.array([0.0, 0, 0, 0, 0, 0, 2, 0])
    assert merit(v, roofed, 60).lit == 1
    assert merit(above, roofed, 60).lit == 0
