"""Voronoi: every pixel takes the color of the nearest cell center (paper, Sec. 4.2 and S1).

Swapping two cells leaves the image unchanged, so n cells have n! optima, and the image is constant
where no boundary crosses a pixel center. The variant "distance" shows how far the nearest center is
instead, the two-cell ambiguity of the paper's Fig. 2.

Notation: n cells, centers c [n, 2] in pixels as (x, y), an image of H rows and W columns whose
pixel centers are (column + 1/2, row + 1/2).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Task, Vector, one_of, whole_number
from fide_tasks.picture_start import cells_of

_MIN_AREA = 0.3  # of a generated cell, relative to the mean area
_MIN_SEPARATION = 0.3  # of generated centers, relative to the root of the mean area
_MIN_CONTRAST = 0.35  # between neighbors of a generated target, Euclidean in RGB
_JUDGING_GRID = 128  # generated targets are judged on a grid of about this many pixels a side


class Voronoi(Task):
    """Cells of one color each around their centers.

    Options
    -------
    cells: number n of cells, at least 1; by default 8 in color, 2 as distance.
    variant: "color", 5 n parameters: x, y, red, green, blue of the first cell, then of the next; or
        "distance", 2 n parameters: x, y of each cell. Gray is then the distance from the nearest
        center divided by the diagonal of the image.
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    One frame takes about 0.2 ms at 224 x 224 with 8 cells, 1.3 ms with 60.

    A generated target depends on `seed`, the options and the aspect ratio, not on the resolution.
    Each of its cells covers at least 0.3 / n of the image, and neighbors differ in color.
    A pixel equally far from two centers belongs to the left one, then to the upper one, then to the
    darker one in red, green, blue: so the order of the cells never shows.
    """

    name = "voronoi"
    alike = "cell"

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        cells: int | None = None,
        variant: str = "color",
        target: ArrayLike | None = None,
    ) -> None:
        self.variant = one_of("variant", variant, ("color", "distance"))
        default = 8 if self.variant == "color" else 2
        self.cells = default if cells is None else whole_number("cells", cells, minimum=1)
        super().__init__(size, seed, target=target)
        height, width = self.size
        place = [("x", "px", width), ("y", "px", height)]
        tint = [("red", "0-1", 1), ("green", "0-1", 1), ("blue", "0-1", 1)]
        self.parameters = tuple(
            Parameter(f"cell {i + 1}", name, unit, 0.0, float(high))
            for i in range(self.cells)
            for name, unit, high in (place + tint if self.variant == "color" else place)
        )

    @property
    def groups(self) -> list[list[int]]:
        """The parameters of each cell."""
        return np.arange(self.dim).reshape(self.cells, -1).tolist()

    def start(self) -> Vector | None:
        """Return cells at superpixels of the target; None for the variant "distance"."""
        if self.variant == "distance":
            return None
        return cells_of(self._target, self.cells).ravel()

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        cells = values.reshape(len(values), self.cells, self.dim // self.cells)
        for v, frame in zip(cells, out, strict=True):
            if self.variant == "color":
                v = v[np.lexsort(v.T[::-1])]  # by x, then y, red, green, blue
                _fill(frame, v[:, :2], v[:, 2:].astype(np.float32))
            else:
                frame[:] = _distance(v, *self.size)[:, :, None] / math.hypot(*self.size)

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, self.cells))
        height, width = self.size
        grid = max(_JUDGING_GRID, 8 * math.isqrt(self.cells)) / math.sqrt(height * width)
        shape = max(1, round(height * grid)), max(1, round(width * grid))
        centers = _spread_centers(rng, self.cells, *shape)
        if self.variant == "distance":
            return centers.ravel()
        colors = _distinct_colors(rng, _neighbors(centers, *shape))
        return np.hstack([centers, colors]).ravel()


def _runs(c: Vector, height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the nearest centers along the image as runs: which cell, over how many pixels."""
    y = np.arange(height) + 0.5
    w = (c[:, :1] ** 2) + (y - c[:, 1:]) ** 2  # (n, H)
    start, stop = np.full_like(w, -np.inf), np.full_like(w, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):  # centers one above the other
        for j in range(1, len(c)):
            apart = 2 * (c[j, 0] - c[:j, :1])  # >= 0
            bisector = (w[j] - w[:j]) / apart  # (j, H): x where cell j takes over
            if apart[-1, 0] == 0:
                bisector[np.isnan(bisector)] = np.inf  # 0 / 0, a tie: to the earlier cell
            bisector.max(axis=0, out=start[j])
            np.minimum(stop[:j], bisector, out=stop[:j])
    first, end = (np.clip(np.floor(s + 0.5), 0, width).astype(np.intp) for s in (start, stop))
    row, cell = np.nonzero((first < end).T)
    begin = np.maximum.accumulate(row * width + first[cell, row])
    begin[0] = 0
    return cell, np.diff(begin, append=height * width)


def _fill(frame: Image, c: Vector, colors: NDArray[np.float32]) -> None:
    """Color every pixel of frame, (H, W, 3), as its nearest center; c sorted by x."""
    shape = frame.shape[0], frame.shape[1]
    cell, length = _runs(c, *shape)
    cv2.merge([np.repeat(colors[cell, k], length).reshape(shape) for k in range(3)], frame)


def _labels(c: Vector, height: int, width: int) -> NDArray[np.intp]:
    """Return the index of the nearest center of each pixel, (H, W); c in any order."""
    order = np.lexsort(c.T[::-1])
    cell, length = _runs(c[order], height, width)
    return order[np.repeat(cell, length)].reshape(height, width)


def _distance(c: Vector, height: int, width: int) -> Vector:
    """Return the distance in pixels from the nearest center, (H, W)."""
    dx2 = (np.arange(width) + 0.5 - c[:, :1]) ** 2
    dy2 = (np.arange(height) + 0.5 - c[:, 1:]) ** 2
    nearest = np.full((height, width), np.inf)
    for across, down in zip(dx2, dy2, strict=True):
        np.minimum(nearest, across + down[:, None], out=nearest)
    root: Vector = np.sqrt(nearest)
    return root


def _spread_centers(rng: np.random.Generator, n: int, height: int, width: int) -> Vector:
    """Draw n centers in [0, 1]^2, none of whose cells is tiny on a grid of this shape."""
    scale = np.array([width, height])
    rows, columns = np.indices((height, width)) + 0.5
    centers = rng.random((n, 2))
    for _ in range(200):
        label = _labels(centers * scale, height, width).ravel()
        area = np.bincount(label, minlength=n)
        if area.min() * n >= _MIN_AREA * label.size and _separated(centers * scale, label.size):
            break
        weights = np.maximum(area, 1)
        x = np.bincount(label, columns.ravel(), n) / weights / width
        y = np.bincount(label, rows.ravel(), n) / weights / height
        centroids = np.where(area[:, None] > 0, np.stack([x, y], axis=1), rng.random((n, 2)))
        centers = (centers + centroids) / 2
    return centers


def _separated(c: Vector, area: int) -> bool:
    from scipy.spatial import KDTree

    if len(c) == 1:
        return True
    distance, _ = KDTree(c).query(c, k=2)
    return bool(distance[:, 1].min() >= _MIN_SEPARATION * math.sqrt(area / len(c)))


def _neighbors(centers: Vector, height: int, width: int) -> list[set[int]]:
    """Return, for each center in [0, 1]^2, which cells touch its own on a grid of this shape."""
    label = _labels(centers * [width, height], height, width)
    touching: list[set[int]] = [set() for _ in centers]
    for a, b in ((label[:, :-1], label[:, 1:]), (label[:-1], label[1:])):
        for i, j in np.unique(np.stack([a[a != b], b[a != b]], axis=1), axis=0).tolist():
            touching[i].add(j)
            touching[j].add(i)
    return touching


def _distinct_colors(rng: np.random.Generator, touching: list[set[int]]) -> Vector:
    """Draw a color for each cell, (n, 3), that can be told from those of its neighbors."""
    colors = np.full((len(touching), 3), np.inf)
    for i, others in enumerate(touching):
        draws = rng.random((64, 3))
        drawn = colors[[j for j in others if j < i]]
        contrast = np.linalg.norm(draws[:, None] - drawn, axis=2).min(axis=1, initial=np.inf)
        enough = np.flatnonzero(contrast >= _MIN_CONTRAST)
        colors[i] = draws[enough[0] if enough.size else contrast.argmax()]
    return colors
