"""The generated courtyard: its triangles, their fronts, and the room it leaves the camera."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_tasks.courtyard import Mesh, courtyard
from fide_tasks.courtyard.mesh import box, lathe, srgb

Array = NDArray[np.float64]
LOW, HIGH = np.array([7.0, 1.0, -2.0]), np.array([25.0, 10.0, 12.0])  # of the camera


def corners(mesh: Mesh) -> tuple[Array, Array, Array]:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return a, b, c


def facing(mesh: Mesh) -> Array:
    """Twice the area of each triangle, along its front, (f, 3)."""
    a, b, c = corners(mesh)
    return np.cross(b - a, c - a)


def volume(mesh: Mesh) -> float:
    """What a closed mesh encloses; negative if it is inside out."""
    a, b, c = corners(mesh)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def first_hit(mesh: Mesh, origin: Array, direction: Array) -> tuple[float, int]:
    """Distance to the nearest triangle along a ray, and which one; inf and -1 if there is none."""
    a, b, c = corners(mesh)
    edge1, edge2 = b - a, c - a
    p = np.cross(direction, edge2)
    det = np.einsum("ij,ij->i", edge1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ij,ij->i", origin - a, p) / det
        q = np.cross(origin - a, edge1)
        v = q @ direction / det
        t = np.einsum("ij,ij->i", edge2, q) / det
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6), t, np.inf)
    nearest = int(t.argmin())
    return float(t[nearest]), nearest if np.isfinite(t[nearest]) else -1


def test_is_built_once_and_always_the_same() -> None:
    assert courtyard() is courtyard()
    again = courtyard.__wrapped__()
    for name in ("vertices", "normals", "colors", "faces"):
        np.testing.assert_array_equal(getattr(again, name), getattr(courtyard(), name))


# Number of triangles, their area in square meters, and its moments by place and by color.
REFERENCE = [
    58464,
    5754.98624141,
    94504.5538393,
    30238.3394344,
    26783.7832065,
    2785.63415476,
    1750.19527816,
    1091.15383683,
]


def test_is_the_same_on_every_machine() -> None:
    mesh = courtyard()
    area = np.linalg.norm(facing(mesh), axis=1)[:, None] / 2
    middle = sum(corners(mesh)) / 3
    color = mesh.colors[mesh.faces].mean(axis=1)
    measured = [len(mesh.faces), area.sum(), *(area * middle).sum(0), *(area * color).sum(0)]
    np.testing.assert_allclose(measured, REFERENCE, rtol=1e-9)


def test_has_no_triangle_without_area_and_nothing_undefined() -> None:
    mesh = courtyard()
    for values in (mesh.vertices, mesh.normals, mesh.colors):
        assert values.shape == (len(mesh.vertices), 3)
        assert np.isfinite(values).all()
    assert mesh.faces.min() == 0
    assert mesh.faces.max() < len(mesh.vertices)
    assert np.linalg.norm(facing(mesh), axis=1).min() > 1e-4
    assert mesh.colors.min() >= 0
    assert mesh.colors.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test_normals_are_on_the_front_of_their_triangles() -> None:
    mesh = courtyard()
    front = facing(mesh) / np.linalg.norm(facing(mesh), axis=1, keepdims=True)
    assert np.einsum("fi,fki->fk", front, mesh.normals[mesh.faces]).min() > 0.4


def test_surrounds_the_camera_and_leaves_it_room() -> None:
    mesh = courtyard()
    assert (mesh.vertices.min(axis=0) < LOW - 1).all()
    assert (mesh.vertices.max(axis=0) > HIGH + 1).all()
    rng = np.random.default_rng(0)
    rays, down, lost, behind, close = 150, 0, 0, 0, 0
    for _ in range(rays):
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        distance, face = first_hit(mesh, rng.uniform(LOW, HIGH), direction)
        down += direction[1] < 0
        lost += direction[1] < 0 and face < 0
        behind += face >= 0 and facing(mesh)[face] @ direction > 0
        close += distance < 0.3
    assert down > 50
    assert lost == 0, "rays below the horizon escape through a gap"
    assert behind < 0.12 * rays, "only leaves, flags and the like show their backs"
    assert close < 0.06 * rays


def test_boxes_and_solids_of_revolution_enclose_their_volume() -> None:
    assert volume(box((1, 2, 3), (2, 4, 6), [1, 1, 1])) == pytest.approx(6)
    polygon = 12 / 2 * np.sin(2 * np.pi / 12)  # a regular one of 12 sides and radius 1
    profile = [(0, 0), (2, 0), (2, 3), (0, 3)]
    for faceted in (False, True):
        drum = lathe(profile, 12, [1, 0, 0], faceted=faceted)
        assert volume(drum) == pytest.approx(4 * polygon * 3)
        assert len(drum.faces) == 12 * (1 + 2 + 1), "a triangle at the axis, two at the wall"
    cone = lathe([(0, 0), (1, 0), (0, 3)], 12, [1, 0, 0])
    assert volume(cone) == pytest.approx(polygon)


def test_colors_are_linear() -> None:
    np.testing.assert_allclose(srgb("#ffffff"), 1)
    np.testing.assert_allclose(srgb("#000000"), 0)
    np.testing.assert_allclose(srgb("#bc0b80"), [0.502886, 0.003347, 0.215861], atol=1e-6)
