"""Lamps: point lamps of several colors before a brick wall, seen by a camera.

Light adds up, so n lamps can be exchanged and have n! optima, whatever their order. Two parameters
belong to no lamp: ambient light and the exposure of the camera.

Notation: lamp i at (x, y) at the height h above the wall, with the color c_i; a point of the wall
at the distance r from (x, y) gets the irradiance c_i (1 + r^2 / h^2)^(-3/2), the cosine law of a
point lamp relative to its own peak. Radiance L = albedo (ambient + sum of irradiances), and
1 - exp(-2^s L) is the image at the exposure of s stops.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Vector, whole_number
from fide_tasks.generated import GeneratedTask, axes, half_extent

_KINDS = 6  # parameters of a lamp
_STOPS = (-1.0, 1.5)
_ROWS = 11  # of bricks on the shorter side
_MORTAR = 0.09  # of the height of a brick
_WINDOW = (0.30, -0.30, 0.075)  # center and radius, in sides
_WINDOW_LIGHT = np.array([0.75, 0.62, 0.35], np.float32)
_SEPARATION = 0.18  # between lamps of a target, in sides, for up to 8 lamps

Plane = NDArray[np.float32]


class Lamps(GeneratedTask):
    """Point lamps on a wall of bricks, with ambient light and exposure.

    Options
    -------
    lamps: number n of lamps, at least 1; by default 5.
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 6 n + 2 parameters are x, y and height above the wall in sides, red, green and blue of each
    lamp; then ambient light, 0 to 0.3, and exposure, -1 to 1.5 stops. A round window of known
    brightness tells exposure from the power of the lamps.

    `seed` chooses the target: lamps apart from each other, bright and colored.
    """

    name = "lamps"

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        lamps: int = 5,
        target: ArrayLike | None = None,
    ) -> None:
        self.lamps = whole_number("lamps", lamps, minimum=1)
        super().__init__(size, seed, target=target)
        across, down = half_extent(self.size)
        kinds = (
            ("x", "sides", -across, across),
            ("y", "sides", -down, down),
            ("height", "sides", 0.06, 0.3),
            *((color, "0-1", 0.0, 1.0) for color in ("red", "green", "blue")),
        )
        self.parameters = (
            *(Parameter(f"lamp {i + 1}", *kind) for i in range(self.lamps) for kind in kinds),
            Parameter("wall", "ambient", "0-1", 0.0, 0.3),
            Parameter("camera", "exposure", "stops", *_STOPS),
        )

    @property
    def groups(self) -> list[list[int]]:
        """The parameters of each lamp."""
        return np.arange(_KINDS * self.lamps).reshape(self.lamps, _KINDS).tolist()

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        shape = out.shape[1], out.shape[2]
        wall, window = _bricks(*shape), _round_window(*shape)
        lamps = values[:, np.array(self.groups)].astype(np.float32)  # (n, lamps, 6)
        for v, (ambient, stops), frame in zip(lamps, values[:, -2:], out, strict=True):
            weights = np.stack([_falloff(lamp, *shape).ravel() for lamp in v])
            light = (weights.T @ v[:, 3:]).reshape(frame.shape) + np.float32(ambient)
            radiance = wall * light + window
            np.exp(np.float32(-(2**stops)) * radiance, out=frame)
            np.subtract(1, frame, out=frame)

    def _required_change(self) -> float:
        return self.least_change * 5 / max(self.lamps, 5)

    def _draw(self, rng: np.random.Generator) -> Vector:
        lamps = rng.random((self.lamps, _KINDS))
        lamps[:, :2] = _apart(rng, self.lamps, half_extent(self.size))
        lamps[:, 2] = rng.uniform(0.1, 0.9, self.lamps)
        color = rng.random((self.lamps, 3))
        lamps[:, 3:] = 0.1 + 0.85 * (color - color.min(axis=1, keepdims=True)) / np.ptp(
            color, axis=1, keepdims=True
        )
        x = np.empty(self.dim)
        x[np.array(self.groups)] = lamps
        x[-2:] = rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.8)
        return x


def _falloff(lamp: Plane, rows: int, columns: int) -> Plane:
    """Return (1 + r^2 / h^2)^(-3/2) on the wall, (H, W); lamp: x, y, h and more."""
    across, down = axes(rows, columns)
    x, y, height = lamp[:3]
    scale = 1 / (height * height)
    q = 1 / ((across - x) ** 2 * scale + ((down - y) ** 2 * scale + 1))
    return np.asarray(q * np.sqrt(q), np.float32)


def _apart(rng: np.random.Generator, n: int, half: tuple[float, float]) -> Vector:
    """Draw n places in [0.08, 0.92]^2, as far apart as the best of many draws for each allows."""
    sides = 2 * np.array(half)
    wanted = _SEPARATION * min(1.0, (8 / n) ** 0.5)
    places = np.empty((0, 2))
    for _ in range(n):
        draws = rng.uniform(0.08, 0.92, (64, 2))
        gaps = np.linalg.norm((draws[:, None] - places) * sides, axis=2).min(axis=1, initial=np.inf)
        enough = np.flatnonzero(gaps >= wanted)
        places = np.vstack([places, draws[enough[0] if enough.size else gaps.argmax()]])
    return places


@cache
def _bricks(height: int, width: int) -> NDArray[np.float32]:
    """Return the albedo of a wall of bricks, (H, W, 3), with smooth joints."""
    x, y = (a.astype(np.float64) for a in axes(height, width))
    soft = max(_ROWS / min(height, width), 0.04)  # a pixel, in heights of a brick
    v = y * _ROWS + 100
    row = np.floor(v)
    u = x * _ROWS / 2.2 + 100 + 0.5 * (row % 2)
    column = np.floor(u)
    edge = np.minimum(_edge_distance(v), 2.2 * _edge_distance(u))
    brick = np.clip((edge - _MORTAR) / soft + 0.5, 0, 1)[:, :, None]
    tone = np.modf(np.abs(np.sin(row * 12.9898 + column * 78.233)) * 43758.5453)[0][:, :, None]
    grain = 0.04 * np.sin(9 * u + 3 * row) * np.sin(11 * v + 5 * column)
    clay = np.array([0.80, 0.62, 0.52]) * (0.72 + 0.28 * tone) + grain[:, :, None]
    wall = brick * clay + (1 - brick) * np.array([0.93, 0.91, 0.88])
    return np.asarray(wall * _outside_window(height, width)[:, :, None], np.float32)


def _edge_distance(u: Vector) -> Vector:
    """Return the distance from the nearest whole number."""
    return np.asarray(np.abs(u - np.rint(u)))


def _outside_window(height: int, width: int) -> Plane:
    x, y = axes(height, width)
    distance = np.hypot(x - _WINDOW[0], y - _WINDOW[1])
    return np.asarray(np.clip((distance - _WINDOW[2]) * min(height, width) + 0.5, 0, 1))


@cache
def _round_window(height: int, width: int) -> NDArray[np.float32]:
    """Return the radiance of the window, (H, W, 3): a disc with two bars."""
    x, y = axes(height, width)
    bars = np.minimum(np.abs(x - _WINDOW[0]), np.abs(y - _WINDOW[1])) * min(height, width)
    glass = (1 - _outside_window(height, width)) * np.clip(bars - 0.2, 0.25, 1)
    return np.asarray(glass[:, :, None] * _WINDOW_LIGHT, np.float32)
