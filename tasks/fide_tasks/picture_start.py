"""Where to begin with a picture of the user's own: parameters that are read off its pixels.

No render is spent.  Notation: n pixels, positions p [n, 2] as (x, y) in [0, 1], values v [n, 3].
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image, Vector

_PIXELS = 128**2  # of the picture that is clustered, at most
_NEARNESS = 0.5  # a cell's width weighs as much as this difference of color
_ITERATIONS = 20
_SHORTEST = 0.1  # path, in units of the root of the area of the picture


def cells_of(picture: Image, cells: int) -> Vector:
    """Place Voronoi cells in a picture, (H, W, 3): x, y in [0, 1], red, green, blue, (cells, 5).

    Pixels are clustered by position and color, as superpixels are (Achanta et al. 2012, "SLIC
    superpixels compared to state-of-the-art superpixel methods"), by k-means. A cell gets the place
    of a cluster, and the mean color of the pixels that are nearest to it. The same picture gives
    the same cells.
    """
    p, v, aspect = _pixels(picture)
    place = p * aspect
    near = place * (_NEARNESS * math.sqrt(cells))
    points = np.hstack([near, v])
    first = np.random.default_rng(0).choice(len(p), cells, replace=cells > len(p))
    label = _k_means(points, points[first])
    centers = _means(p, label, p[first])
    colors = _means(v, _nearest(place, centers * aspect), v[first])
    return np.hstack([centers, colors])


def stroke_of(picture: Image, control_points: int) -> Vector | None:
    """Place a stroke on the dark pixels of a picture, (H, W, 3); None if there are none.

    Returns x, y in [0, 1] of each control point, and the thickness in units of the shorter side:
    (2 control_points + 1,). The points are the centers of a k-means clustering, in the order of the
    shortest path that a walk to the nearest one finds from any of them. The ends of the path are
    moved half a step out. The stroke covers as much as the dark pixels do.
    """
    p, v, aspect = _pixels(picture)
    dark = v.mean(axis=1) < 0.5
    if not dark.any():
        return None
    place = p[dark] * aspect
    first = np.random.default_rng(0).choice(len(place), control_points, replace=True)
    centers = _means(place, _k_means(place, place[first]), place[first])
    path = _shortest_walk(centers)
    path[[0, -1]] += (path[[0, -1]] - path[[1, -2]]) / 2
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    thickness = dark.mean() / max(length, _SHORTEST) / aspect.min()
    x: Vector = np.clip(np.append(path / aspect, thickness), 0.0, 1.0)
    return x


def _shortest_walk(points: Vector) -> Vector:
    """Order points: the shortest of the walks, one from each point, always to the nearest left."""
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    walks = [_walk(apart, start) for start in range(len(points))]
    return points[min(walks, key=lambda walk: float(apart[walk[:-1], walk[1:]].sum()))]


def _walk(apart: Vector, start: int) -> list[int]:
    walk, left = [start], set(range(len(apart))) - {start}
    while left:
        walk.append(min(left, key=lambda i: (apart[walk[-1], i], i)))
        left.remove(walk[-1])
    return walk


def _pixels(picture: Image) -> tuple[Vector, Vector, Vector]:
    """Return p, v, and the sides of the picture in units of the root of its area."""
    height, width = picture.shape[:2]
    scale = min(1.0, math.sqrt(_PIXELS / (height * width)))
    h, w = max(1, round(scale * height)), max(1, round(scale * width))
    small = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
    y, x = np.indices((h, w)).reshape(2, -1) + 0.5
    aspect = np.array([width, height]) / math.sqrt(height * width)
    return np.stack([x / w, y / h], axis=1), small.reshape(-1, 3).astype(np.float64), aspect


def _k_means(points: Vector, centers: Vector) -> NDArray[np.intp]:
    """Return the cluster of each point after some of Lloyd's iterations from these centers."""
    label = _nearest(points, centers)
    for _ in range(_ITERATIONS):
        centers = _means(points, label, centers)
        label = _nearest(points, centers)
    return label


def _nearest(points: Vector, centers: Vector) -> NDArray[np.intp]:
    from scipy.spatial import KDTree

    nearest: NDArray[np.intp] = KDTree(centers).query(points)[1]
    return nearest


def _means(points: Vector, label: NDArray[np.intp], empty: Vector) -> Vector:
    """Mean of the points of each cluster; that of `empty` where a cluster has none."""
    count = np.bincount(label, minlength=len(empty))[:, None]
    sums = [np.bincount(label, column, len(empty)) for column in points.T]
    return np.where(count > 0, np.stack(sums, axis=1) / np.maximum(count, 1), empty)
