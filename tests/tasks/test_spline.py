"""Spline: the curve against SciPy, the stroke against distances, the ampersand against topology."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial import KDTree

import fide_tasks
from fide_tasks.spline import FACES, _basis, ampersand

Array = NDArray[np.float64]
HOLES = {  # the counters of each ampersand: the upper loop is open in the DejaVu family
    "DejaVuSans": 1,
    "cmss10": 2,
    "STIXGeneral": 2,
    "DejaVuSerif": 1,
    "STIXGeneralItalic": 2,
    "DejaVuSansMono": 1,
    "cmr10": 2,
    "DejaVuSans-Oblique": 1,
}


def curve(points: Array, samples: int = 2000) -> Array:
    """Sample SciPy's clamped uniform B-spline of degree 2 (1 for two points)."""
    m = len(points)
    degree = min(2, m - 1)
    inner = np.arange(1, m - degree)
    knots = np.r_[[0] * (degree + 1), inner, [m - degree] * (degree + 1)].astype(float)
    u = np.linspace(0, m - degree, samples, endpoint=False)
    return np.asarray(BSpline(knots, points, degree)(u))


def ink(x: Array, size: int = 112, m: int = 7) -> Array:
    """Render one candidate and return how black each pixel is."""
    image = fide_tasks.make("spline", size, control_points=m).render(x[None])[0]
    return np.asarray(1.0 - image[:, :, 0].astype(np.float64))


def distances(points: Array, size: int) -> Array:
    """Distance in pixels of each pixel center from the curve; points in [0, 1]."""
    y, x = np.mgrid[:size, :size] + 0.5
    return np.asarray(KDTree(curve(points * size)).query(np.stack([x, y], axis=2))[0])


@pytest.mark.parametrize("m", [2, 3, 4, 5, 6, 7, 12])
def test_the_basis_is_scipys(m: int) -> None:
    basis, slope = _basis(m, 224)
    points = np.random.default_rng(m).random((m, 2))
    np.testing.assert_allclose((basis @ points)[:-1], curve(points, len(basis) - 1), atol=1e-12)
    np.testing.assert_allclose(basis.sum(axis=1), 1)
    np.testing.assert_allclose(slope.sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(basis[[0, -1]] @ points, points[[0, -1]])


@pytest.mark.parametrize("m", [2, 3, 5, 7, 10])
@pytest.mark.parametrize("thickness", [2.0, 3.5, 17.3, 60.0, 112.0])
def test_the_stroke_is_all_within_half_its_thickness(m: int, thickness: float) -> None:
    rng = np.random.default_rng(m)
    for _ in range(4):
        points = rng.random((m, 2))
        black = ink(np.append(points, thickness / 112), m=m)
        outside = distances(points, 112) - thickness / 2
        assert black[outside > 2].max(initial=0) < 0.02
        assert black[outside < -2].min(initial=1) > 0.98


@pytest.mark.parametrize("thickness", [2.0, 2.5, 3.0, 4.0, 7.7, 25.0])
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, 1.3])
def test_a_straight_stroke_has_the_asked_area(thickness: float, angle: float) -> None:
    half = np.array([np.cos(angle), np.sin(angle)]) * 30
    points = (56 + np.stack([-half, half])) / 112
    black = ink(np.append(points, thickness / 112), m=2).sum()
    area = 60 * thickness + np.pi * thickness**2 / 4
    assert abs(black - area) < 0.4 * (120 + np.pi * thickness)  # 0.4 px along its outline


def test_thin_strokes_fade_to_blank_in_proportion() -> None:
    points = np.random.default_rng(0).random(14)
    full = ink(np.append(points, 2 / 112))
    for thickness in (0.0, 0.1, 0.5, 1.0, 1.9):
        black = ink(np.append(points, thickness / 112))
        np.testing.assert_allclose(black, full * thickness / 2, atol=1e-6)


def test_reversing_the_points_leaves_the_stroke() -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        points, t = rng.random((7, 2)), rng.uniform(0.02, 0.5)
        one, other = ink(np.append(points, t)), ink(np.append(points[::-1], t))
        assert np.abs(one - other).mean() < 1e-3


@pytest.mark.parametrize("m", [2, 3, 7])
def test_random_targets_are_never_degenerate(m: int) -> None:
    for seed in range(100):
        task = fide_tasks.make("spline", 112, seed, control_points=m, target="random")
        x = task.x_star
        assert x is not None
        assert np.linalg.norm(np.diff(curve(x[:-1].reshape(-1, 2)), axis=0), axis=1).sum() >= 0.49
        black = 1 - task.target[:, :, 0]
        assert 0.01 < black.mean() < 0.5
        assert max(black[0].max(), black[-1].max(), black[:, 0].max(), black[:, -1].max()) == 0


@pytest.mark.parametrize("face", range(len(FACES)))
@pytest.mark.parametrize("size", [112, 224])
def test_the_glyph_has_the_topology_of_an_ampersand(face: int, size: int) -> None:
    black = (ampersand((size, size), face)[:, :, 0] < 0.5).astype(np.uint8)
    strokes = cv2.connectedComponents(black, connectivity=8)[0] - 1
    holes = cv2.connectedComponents(1 - black, connectivity=4)[0] - 2
    assert strokes == 1
    assert holes == HOLES[FACES[face]]


@pytest.mark.parametrize("size", [(224, 224), (64, 64), (60, 200), (200, 60)])
def test_the_glyph_is_centered_and_fills_the_image(size: tuple[int, int]) -> None:
    for seed in range(len(FACES)):
        task = fide_tasks.make("spline", size, seed)
        assert task.x_star is None
        rows, columns = np.nonzero(task.target[:, :, 0] < 0.5)
        extent = np.ptp(rows) / size[0], np.ptp(columns) / size[1]
        assert 0.75 < max(extent) < 0.83
        assert abs(rows.min() + rows.max() + 1 - size[0]) <= 2
        assert abs(columns.min() + columns.max() + 1 - size[1]) <= 2
