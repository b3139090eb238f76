"""Limbs, stick figure and arm: the drawing against distances, kinematics by hand."""

from __future__ import annotations

import numpy as np
import pytest

import fide_tasks
from fide_tasks import arm, generated, stick_figure

# -- limbs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ra", "rb"), [(3.0, 3.0), (2.0, 6.0), (0.4, 0.4)])
def test_a_limb_covers_what_is_nearer_than_its_radius(ra: float, rb: float) -> None:
    frame = np.zeros((40, 50, 3), np.float32)
    a, b = np.array([12.3, 9.8]), np.array([33.1, 27.4])
    generated.paint_limb(frame, a.tolist(), b.tolist(), ra, rb, np.ones(3, np.float32))
    y, x = np.indices((40, 50)) + 0.5
    p = np.stack([x, y], axis=2)
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    d = np.linalg.norm(p - a - t[:, :, None] * (b - a), axis=2)
    r = ra + t * (rb - ra)
    expected = np.clip(r - d + 0.5, 0, 1) * (1 - 0.4 * np.minimum(d / np.maximum(r, 0.5), 1) ** 2)
    np.testing.assert_allclose(frame, np.repeat(expected[:, :, None], 3, axis=2), atol=1e-5)


@pytest.mark.parametrize("end", [(-30.0, 5.0), (25.0, 90.0), (-9.0, -9.0)])
def test_limbs_outside_the_image_are_cut(end: tuple[float, float]) -> None:
    large, small = np.zeros((160, 160, 3), np.float32), np.zeros((40, 50, 3), np.float32)
    start, white = (10.0, 12.0), np.ones(3, np.float32)
    generated.paint_limb(small, start, end, 3.0, 4.0, white)
    moved, moved_end = ((x + 50, y + 50) for x, y in (start, end))
    generated.paint_limb(large, moved, moved_end, 3.0, 4.0, white)
    np.testing.assert_allclose(small, large[50:90, 50:100], atol=1e-5)
    before = small.copy()
    generated.paint_limb(small, (-20.0, 0.0), (-20.0, 40.0), 3.0, 4.0, white)
    np.testing.assert_array_equal(small, before)


# -- stick figure ----------------------------------------------------------------------------------


def test_a_figure_that_stands_straight() -> None:
    ends = stick_figure.pose(np.array([0.1, 0.2, 0.5, *[0.0] * 13]))
    lengths = {bone: length for bone, (_, length, _, _) in stick_figure.BONES.items()}
    up = lengths["belly"] + lengths["chest"]
    np.testing.assert_allclose(ends["chest"][1], (0.1, 0.2 - 0.5 * up))
    np.testing.assert_allclose(ends["near forearm"][1], (0.1, 0.2 - 0.5 * (up - 0.32)), atol=1e-12)
    np.testing.assert_allclose(ends["far shin"][1], (0.1, 0.2 + 0.5 * 0.46))
    np.testing.assert_allclose(ends["far foot"][1], (0.1 + 0.5 * 0.09, 0.2 + 0.5 * 0.46))
    np.testing.assert_allclose(ends["nose"][1][0], 0.1 + 0.5 * lengths["nose"])


def test_bones_turn_with_those_they_hang_on() -> None:
    """Forward kinematics by complex numbers; x to the right, y down."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        hips, height, angles = rng.random(2), rng.uniform(0.6, 1.1), rng.uniform(-90, 90, 13)
        ends = stick_figure.pose(np.array([*hips, height, *angles]))
        lean, spine, _, _, _, shoulder, elbow, *_ = np.exp(1j * np.radians(angles))
        hip, knee, ankle = np.exp(1j * np.radians(angles[10:]))
        root = complex(*hips)
        chest = root - 1j * height * lean * (0.14 + 0.17 * spine)
        hand = chest + 1j * height * lean * spine * shoulder * (0.16 + 0.16 * elbow)
        toes = root + 1j * height * hip * (0.23 + knee * (0.23 - 1j * 0.09 * ankle))
        np.testing.assert_allclose(complex(*ends["near forearm"][1]), hand)
        np.testing.assert_allclose(complex(*ends["near foot"][1]), toes)


# -- arm -------------------------------------------------------------------------------------------


def test_an_arm_in_a_plane_is_a_chain_of_two_dimensions() -> None:
    """Without rolls: the pitch angles add up, and the yaw turns the plane."""
    rng = np.random.default_rng(4)
    for yaw, shoulder, elbow, wrist in np.radians(rng.uniform(-90, 90, (10, 4))):
        angles = np.degrees([yaw, shoulder, elbow, 0, wrist, 0])
        places, _ = arm.forward_kinematics(angles)
        pitch = np.cumsum([shoulder, elbow, wrist])
        length = np.array([0.5, 0.24 + 0.2, 0.16 + 0.06])
        reach, height = length @ np.sin(pitch), 0.35 + length @ np.cos(pitch)
        expected = reach * np.cos(yaw), reach * np.sin(yaw), height
        np.testing.assert_allclose(places[-1], expected, atol=1e-12)


def test_the_camera_looks_at_the_arm() -> None:
    points = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 1.0], [0.21, 0.19, 0.6]])
    x_y, depth = arm.project(points)
    np.testing.assert_allclose(x_y[0], 0, atol=1e-12)
    np.testing.assert_allclose(depth[0], np.linalg.norm([1.9, -2.1, 0.9]))
    assert x_y[1, 1] < 0, "what is higher is higher in the image"
    assert x_y[2, 0] > 0.05, "to the right of the line of sight"


def test_targets_of_the_arm_are_above_the_floor_and_in_the_picture() -> None:
    for seed in range(20):
        task = fide_tasks.make("arm", 56, seed)
        assert task.x_star is not None
        ends = arm.rods(task._physical(task.x_star))[2:].reshape(-1, 3)
        assert ends[:, 2].min() > 0
        assert np.abs(arm.project(ends)[0]).max() < 0.5
