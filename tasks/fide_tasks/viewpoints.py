"""Choose a camera and a point light that show something of a scene, by a coarse grid of rays.

A view is v = (camera x, y, z, theta, phi, light x, y, z) in meters and degrees; theta is the angle
between the view and the upward Y axis, phi turns from X (0) to Z (90).  Rays [n, 3].
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Vector

Cast = Callable[[Vector, Vector], tuple[Vector, Vector]]
"""Origins and unit directions, (n, 3) each -> distances (n,), inf for none, and normals (n, 3)."""

_GRID = 16  # rays across the image
_DRAWS = 400
_MARGIN = 0.06  # of the box that is left free at either end
_THETA = (68.0, 118.0)  # degrees; not far from the horizon
_SKIN = 1e-3  # m by which a shadow ray keeps clear of the surface
_CLOSE = 1.5  # m; nearer surfaces are in the way
_FAR = 5.0  # m; farther surfaces make the view deep
_BLINDING, _DIM = 2.5, 11.0  # m from the light; surfaces are white below, and dark beyond


class Merit(NamedTuple):
    """What a view shows, in shares of the image."""

    sky: float  # sees no surface
    close: float  # sees one right before the lens
    far: float  # sees one that is far
    edges: float  # borders on a part of the image at another depth, or with another normal
    lit: float  # sees a surface that the light shines on, not from too far
    blinding: float  # sees one very near the light

    @property
    def shortfall(self) -> float:
        """How much is missing from a good view, 0 for none."""
        return (
            max(0.0, self.sky - 0.25)
            + max(0.0, self.close - 0.02)
            + max(0.0, 0.4 - self.far)
            + max(0.0, 0.35 - self.edges)
            + max(0.0, 0.35 - self.lit)
            + max(0.0, self.blinding - 0.05)
        )


def choose(rng: np.random.Generator, low: Vector, high: Vector, cast: Cast, fov: float) -> Vector:
    """Draw views between low and high, (8,) each, and return the first good one, (8,).

    If none of many draws is good, as in a scene that is hardly there, it is the best of them.
    """
    margin = _MARGIN * (high - low)
    low, high = low + margin, high - margin
    low[3], high[3] = np.clip(_THETA, low[3], high[3])
    best, least = low, math.inf
    for _ in range(_DRAWS):
        v = rng.uniform(low, high)
        shortfall = merit(v, cast, fov).shortfall
        if shortfall < least:
            best, least = v, shortfall
        if least == 0:
            break
    return best


def merit(v: Vector, cast: Cast, fov: float) -> Merit:
    """Judge the view v, (8,), of a square image with a field of view of `fov` degrees."""
    directions = _pencil(float(v[3]), float(v[4]), fov)
    distance, normal = cast(np.broadcast_to(v[:3], directions.shape), directions)
    hit = np.isfinite(distance)
    normal = -normal * np.sign(np.einsum("ij,ij->i", normal, directions))[:, None]
    point = v[:3] + directions * np.where(hit, distance, 0.0)[:, None]
    to_light = v[5:] - point
    reach = np.linalg.norm(to_light, axis=1)
    to_light /= np.maximum(reach, _SKIN)[:, None]
    faces = hit & (np.einsum("ij,ij->i", normal, to_light) > 0.1)
    blocked, _ = cast(point + _SKIN * normal, to_light)
    lit = faces & (blocked > reach - 2 * _SKIN)
    return Merit(
        sky=float(1 - hit.mean()),
        close=float((distance < _CLOSE).mean()),
        far=float((hit & (distance > _FAR)).mean()),
        edges=float(_edges(distance, normal).mean()),
        lit=float((lit & (reach < _DIM)).mean()),
        blinding=float((lit & (reach < _BLINDING)).mean()),
    )


def axes(theta: float, phi: float) -> tuple[Vector, Vector, Vector]:
    """Return right, up and forward of a camera that looks along theta, phi in degrees.

    Right is always level, so there is no direction in which the camera could not be held.
    """
    t, p = math.radians(theta), math.radians(phi)
    forward = np.array([math.sin(t) * math.cos(p), math.cos(t), math.sin(t) * math.sin(p)])
    right = np.array([-math.sin(p), 0.0, math.cos(p)])
    return right, np.cross(right, forward), forward


def _pencil(theta: float, phi: float, fov: float) -> Vector:
    """Unit directions through a grid over the image, row by row from the upper left, (n, 3)."""
    right, up, forward = axes(theta, phi)
    step = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
    y, x = np.meshgrid(-step, step, indexing="ij")
    half = math.tan(math.radians(fov) / 2)
    d = forward + half * (x.reshape(-1, 1) * right + y.reshape(-1, 1) * up)
    directions: Vector = d / np.linalg.norm(d, axis=1, keepdims=True)
    return directions


def _edges(distance: Vector, normal: Vector) -> NDArray[np.bool_]:
    """Which cells of the grid differ from the one to the right, or from the one below."""
    depth = np.log(np.where(np.isfinite(distance), distance, 1e3) + _SKIN).reshape(_GRID, _GRID)
    n = np.where(np.isfinite(distance)[:, None], normal, [0.0, 1.0, 0.0])  # the sky is even
    n = n.reshape(_GRID, _GRID, 3)
    edge = np.zeros((_GRID, _GRID), np.bool_)
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        turned = np.einsum("ijk,ijk->ij", n[here], n[there]) < 0.9
        edge[here] |= (np.abs(depth[here] - depth[there]) > 0.15) | turned
    return edge.ravel()
