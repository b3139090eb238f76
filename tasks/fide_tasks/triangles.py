"""Triangles: a picture by semi-transparent triangles, painted over each other in their order.

The benchmark of Tian and Ha (2022), "Modern Evolution Strategies for Creativity: Fitting Concrete
Images and Abstract Concepts", arXiv 2109.08857, with the numbers of their program es-clip: ten for
a triangle, each taken relative to the same number of all other triangles.

Notation: T triangles, P pixels; a triangle covers a share c of a pixel, and its paint has the
opacity a, so A = a c [T, P]. What is painted last is in front, and of the triangle j there remains

    w_j = A_j (1 - A_j+1) ... (1 - A_T),

of the background what all of them let through.

Their triangles have corners on whole pixels and hard edges. These are anti-aliased, so that the
image varies continuously with every number: c falls from 1 to 0 on the pixel around an edge.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Task, Vector, one_of, whole_number

_KINDS = ("x 1", "y 1", "x 2", "y 2", "x 3", "y 3", "red", "green", "blue", "opacity")
_OPACITY, _GRAY = 0.5, 0.5  # of the most opaque triangle; of the background
_BLOCK = 4096  # pixels that are painted at a time; what they need stays in the cache
_LEAST_CROP = 0.4  # of the shorter side of the photograph

Plane = NDArray[np.float32]


class Triangles(Task):
    """Semi-transparent triangles before a plain background.

    Options
    -------
    triangles: number T, at least 2; by default 50.
    target: "photograph" (the default); "random", triangles of this task's own, so that x_star is
        known; or a picture of the user's own, float (H, W, 3) in [0, 1].

    The 10 T parameters are x and y of three corners, 0 and 1 being the edges of the image, red,
    green, blue and the opacity from 0 to 1/2, of each triangle from back to front, each relative to
    the least and the largest of all triangles. es-clip paints on noise, whose mean is this gray.

    `seed` chooses the part of the photograph; seed 0 is all of it that has the shape of the image.

    Raises ValueError for an option out of range.
    """

    name = "triangles"

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        triangles: int = 50,
        target: str | ArrayLike = "photograph",
    ) -> None:
        self.triangles = whole_number("triangles", triangles, minimum=2)
        drawn = isinstance(target, str)
        self._subject = one_of("target", target, ("photograph", "random")) if drawn else "picture"
        super().__init__(size, seed, target=None if drawn else target)
        self.parameters = tuple(
            Parameter(f"triangle {i + 1}", kind, "relative", 0.0, 1.0)
            for i in range(self.triangles)
            for kind in _KINDS
        )

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        v = _relative(values.reshape(len(values), self.triangles, len(_KINDS)))
        for triangles, frame in zip(v, out, strict=True):
            paint = triangles[:, 6:].astype(np.float32)
            paint[:, 3] *= np.float32(_OPACITY)
            _paint(frame, triangles[:, :6].reshape(-1, 3, 2), paint)

    def _make_x_star(self) -> Vector | None:
        if self._subject != "random":
            return None
        return np.random.default_rng((self.seed, self.dim)).random(self.dim)

    def _make_target(self) -> Image:
        if self._subject == "random":
            return super()._make_target()
        return _photograph(self.size, self.seed)


def _relative(v: Vector) -> Vector:
    """Numbers (n, T, kinds) relative to the range of their kind; 0.5 where all are the same."""
    low, high = v.min(axis=1, keepdims=True), v.max(axis=1, keepdims=True)
    middle = np.full_like(v, 0.5)
    relative: Vector = np.divide(v - low, high - low, out=middle, where=high > low)
    return relative


def _paint(frame: Image, corners: Vector, paint: Plane) -> None:
    """Paint triangles with corners (T, 3, 2) in [0, 1] and paint (T, 4) into frame (H, W, 3)."""
    height, width, _ = frame.shape
    edges, sharpness = _edges(corners * (width, height))
    color = np.vstack([np.full(3, _GRAY, np.float32), paint[:, :3]])
    rows = max(1, _BLOCK // width)
    for first in range(0, height, rows):
        block = frame[first : first + rows]
        A = _covered(edges, sharpness, first, block.shape[:2]) * paint[:, 3:]
        block[:] = (_remaining(A).T @ color).reshape(block.shape)
    np.clip(frame, 0, 1, out=frame)  # rounding


def _edges(corners: Vector) -> tuple[Plane, Plane]:
    """Distance to the lines of the edges, (T, 3, 3), and how sharp a triangle is, (T, 1)."""
    along = np.roll(corners, -1, axis=1) - corners
    double = along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0]  # area, signed
    length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)
    inward = along[..., ::-1] * (-1.0, 1.0) / length[..., None]
    inward *= np.where(double < 0, -1.0, 1.0)[:, None, None]
    offset = -(inward * corners).sum(axis=2, keepdims=True)
    sharpness = np.minimum(2 * np.abs(double) / length.sum(axis=1), 1.0)
    edges = np.concatenate([inward, offset], axis=2)
    return edges.astype(np.float32), sharpness[:, None].astype(np.float32)


def _covered(edges: Plane, sharpness: Plane, first: int, size: tuple[int, int]) -> Plane:
    """Share of each pixel that each triangle covers, (T, pixels), in rows from `first` on."""
    y, x = np.mgrid[first : first + size[0], : size[1]].reshape(2, -1) + np.float32(0.5)
    pixels = np.stack([x, y, np.ones_like(x)]).astype(np.float32)
    inside = (edges.reshape(-1, 3) @ pixels).reshape(len(edges), 3, -1).min(axis=1)
    inside += np.float32(0.5)
    return np.asarray(np.clip(inside, 0, 1, out=inside) * sharpness)


def _remaining(A: Plane) -> Plane:
    """What is seen of the background and of each triangle, (1 + T, pixels), of A (T, pixels)."""
    seen = np.empty((len(A) + 1, A.shape[1]), np.float32)
    seen[-1] = 1
    let_through = 1 - A
    for j in reversed(range(len(A))):  # from front to back; np.cumprod takes thirty times as long
        np.multiply(seen[j + 1], let_through[j], out=seen[j])
    seen[1:] *= A
    return seen


def _photograph(size: tuple[int, int], seed: int) -> Image:
    """Part of the portrait of Grace Hopper that comes with Matplotlib (U.S. Navy, no copyright)."""
    try:
        import matplotlib
    except ImportError as error:
        from fide_plugins.runtime.machine import missing

        raise missing("plot", "this task's picture comes with matplotlib") from error
    path = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    picture = cv2.imread(str(path))
    if picture is None:
        raise ValueError(f"no picture can be read from {path}; pass one as target=")
    height, width = picture.shape[:2]
    side = min(height / size[0], width / size[1])  # of a pixel of the target
    top, left = 0.5, 0.5
    if seed:
        share, top, left = np.random.default_rng(seed).uniform((_LEAST_CROP, 0, 0), (0.8, 1, 1))
        side *= share
    h, w = max(1, round(side * size[0])), max(1, round(side * size[1]))
    y, x = round(top * (height - h)), round(left * (width - w))
    part = cv2.resize(picture[y : y + h, x : x + w], size[::-1], interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(part[:, :, ::-1], np.float32) / np.float32(255)
