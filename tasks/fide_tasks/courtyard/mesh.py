"""Colored triangle meshes and the few solids a courtyard is made of.

Y is up, lengths are in meters, and triangles run counterclockwise seen from their front. Every
solid carries its own normals, so round things look round and edges stay sharp.

Notation: v vertices, f triangles, q quadrilaterals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a normal and a color at each vertex.

    vertices: (v, 3) in meters. normals: (v, 3), of unit length. colors: (v, 3), linear RGB in
    [0, 1]. faces: (f, 3), indices of vertices.
    """

    vertices: Array
    normals: Array
    colors: Array
    faces: NDArray[np.int64]

    def placed(self, at: Point = (0, 0, 0), yaw: float = 0.0, scale: float = 1.0) -> Mesh:
        """Return a copy scaled, turned by `yaw` radians about Y (z toward x), then moved."""
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # of row vectors
        vertices = self.vertices @ turn * scale + np.asarray(at)
        return Mesh(vertices, self.normals @ turn, self.colors, self.faces)

    def tinted(self, factor: ArrayLike) -> Mesh:
        """Return a copy with its colors multiplied by `factor`."""
        colors = np.clip(self.colors * np.asarray(factor), 0.0, 1.0)
        return Mesh(self.vertices, self.normals, colors, self.faces)


class Frame(NamedTuple):
    """A place to stand: local x along, y up, z toward the front."""

    at: Point
    yaw: float


def join(parts: Sequence[Mesh]) -> Mesh:
    """Return one mesh of all the parts, in their order."""
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.colors for p in parts]),
        np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=True)]),
    )


def quads(corners: ArrayLike, colors: ArrayLike) -> Mesh:
    """Flat quadrilaterals: corners (q, 4, 3), counterclockwise; colors (3,) or (q, 3)."""
    p = np.asarray(corners, np.float64).reshape(-1, 4, 3)
    normals = _unit(np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1]))
    color = np.broadcast_to(np.asarray(colors, np.float64), (len(p), 3))
    faces = (4 * np.arange(len(p))[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return Mesh(p.reshape(-1, 3), np.repeat(normals, 4, axis=0), np.repeat(color, 4, axis=0), faces)


def box(low: Point, high: Point, color: ArrayLike, hidden: str = "") -> Mesh:
    """A box along the axes; `hidden` names sides to leave out, of "x X y Y z Z" (low and high)."""
    (x, y, z), (X, Y, Z) = low, high
    sides = {
        "x": ((x, y, z), (x, y, Z), (x, Y, Z), (x, Y, z)),
        "X": ((X, y, Z), (X, y, z), (X, Y, z), (X, Y, Z)),
        "y": ((x, y, z), (X, y, z), (X, y, Z), (x, y, Z)),
        "Y": ((x, Y, Z), (X, Y, Z), (X, Y, z), (x, Y, z)),
        "z": ((X, y, z), (x, y, z), (x, Y, z), (X, Y, z)),
        "Z": ((x, y, Z), (X, y, Z), (X, Y, Z), (x, Y, Z)),
    }
    return quads([corners for side, corners in sides.items() if side not in hidden], color)


def lathe(
    profile: Sequence[tuple[float, float]], sides: int, colors: ArrayLike, *, faceted: bool = False
) -> Mesh:
    """The surface that (radius, height) points sweep around Y.

    The outside is to the right of the profile's direction (radius to the right, height up), so an
    upright solid is listed from the bottom up. Segments of the profile stay sharp against one
    another; around the axis the surface is smooth, or `faceted`. `colors` broadcasts to
    (segments, sides, 3).
    """
    p = np.asarray(profile, np.float64)
    along = np.diff(p, axis=0)
    outward = _unit(np.stack([along[:, 1], -along[:, 0]], axis=1))  # (s, 2)
    angle = np.linspace(0.0, 2 * math.pi, sides + 1)
    middle = np.repeat(angle[:-1] + math.pi / sides, 2).reshape(-1, 2) if faceted else None
    turn = np.stack([angle[:-1], angle[1:]], axis=1) if middle is None else middle
    corners = np.empty((len(along), sides, 4, 3))
    normals = np.empty_like(corners)
    for corner, (end, next_side) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        ring = p[end : len(along) + end]
        corners[:, :, corner] = _around(ring, angle[next_side : sides + next_side])
        normals[:, :, corner] = _around(outward, turn[:, next_side])
    color = np.broadcast_to(np.asarray(colors, np.float64), (len(along), sides, 3))
    flat = quads(corners, color.reshape(-1, 3))
    return _without_slivers(Mesh(flat.vertices, normals.reshape(-1, 3), flat.colors, flat.faces))


def tube(path: ArrayLike, radii: ArrayLike, sides: int, color: ArrayLike) -> Mesh:
    """A round limb along `path`, (k, 3), of the given radii, (k,), open at its ends."""
    p, r = np.asarray(path, np.float64), np.asarray(radii, np.float64)
    tangent = _unit(np.gradient(p, axis=0))
    helper = np.where(np.abs(tangent[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]])
    u = _unit(np.cross(tangent, helper))
    v = np.cross(tangent, u)
    angle = np.arange(sides) * (2 * math.pi / sides)
    spoke = u[:, None] * np.cos(angle)[:, None] + v[:, None] * np.sin(angle)[:, None]
    ring = p[:, None] + spoke * r[:, None, None]  # (k, sides, 3)
    i, j = np.meshgrid(np.arange(len(p) - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    faces = np.stack([a, b, b + sides, a, b + sides, a + sides], axis=-1).reshape(-1, 3)
    colors = np.broadcast_to(np.asarray(color, np.float64), (ring.size // 3, 3))
    return Mesh(ring.reshape(-1, 3), spoke.reshape(-1, 3), colors, faces)


def arch(angles: int, center: tuple[float, float], radius: float) -> Array:
    """Points (x, y) of a half circle from its right end over the top to the left, (angles + 1, 2).

    Its ends are exactly on the springing line.
    """
    a = np.linspace(0, math.pi, angles + 1)
    points = np.stack([np.cos(a), np.sin(a)], axis=1) * radius
    points[[0, -1], 1] = 0.0
    return np.asarray(center) + points


def strip(one: ArrayLike, other: ArrayLike, colors: ArrayLike) -> Mesh:
    """Quadrilaterals between two polylines (k, 3); fronts where `one` runs right below `other`."""
    a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
    return quads(np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1), colors)


def fan(center: ArrayLike, rim: ArrayLike, colors: ArrayLike) -> Mesh:
    """Flat triangles from `center`, (3,), to a counterclockwise rim, (k, 3); colors (k - 1, 3)."""
    edge = np.asarray(rim, np.float64)
    middle = np.broadcast_to(np.asarray(center, np.float64), edge[:-1].shape)
    vertices = np.stack([middle, edge[:-1], edge[1:]], axis=1)
    normals = _unit(np.cross(edge[:-1] - middle, edge[1:] - middle))
    color = np.broadcast_to(np.asarray(colors, np.float64), normals.shape)
    return Mesh(
        vertices.reshape(-1, 3),
        np.repeat(normals, 3, axis=0),
        np.repeat(color, 3, axis=0),
        np.arange(3 * len(middle)).reshape(-1, 3),
    )


def at_depth(points: Array, z: float) -> Array:
    """Give points (k, 2) of a facade the depth z: (k, 3)."""
    return np.column_stack([points, np.full(len(points), z)])


def srgb(code: str) -> Array:
    """Return the linear RGB of a color as screens name it, "#rrggbb"."""
    value = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear: Array = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear


def _around(ring: Array, angle: Array) -> Array:
    """Points of radius and height ring, (s, 2), at angles (n,) about Y: (s, n, 3)."""
    radius, height = ring[:, :1], np.broadcast_to(ring[:, 1:], (len(ring), len(angle)))
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=-1)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array = vectors / np.where(length > 0, length, 1.0)
    return unit


def _without_slivers(mesh: Mesh) -> Mesh:
    """Drop triangles without area, which a profile that touches its axis makes."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Mesh(mesh.vertices, mesh.normals, mesh.colors, mesh.faces[area > 1e-12])
