"""Lens: a calibration board seen by a camera whose pose, focal length and lens are to be found.

The squares repeat, so the landscape folds: a board moved by two squares, or turned by a quarter,
fits nearly as well. Three colored discs on the board make the answer unique.

Notation: a point X of the board (z = 0, in squares from its center) is at X_c = R X + t before the
camera, R = R_z(roll) R_x(tilt) R_y(pan); its normalized image (x, y) = (X_c, Y_c) / Z_c is moved by
the lens (Brown-Conrady: radial k1, k2, tangential p1, p2, as `cv2.projectPoints`), with
r^2 = x^2 + y^2,

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2),
    y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y,

and lands f x_d, f y_d from the center of the image. Drawing goes the other way: the lens is
inverted by fixed-point iteration at every pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image, Parameter, Vector
from fide_tasks.generated import GeneratedTask, axes, half_extent

COLUMNS, ROWS = 8, 6  # squares of the board
_BORDER = 0.6  # white around the squares
_DISCS = (  # x, y, radius in squares, color
    (-2.5, -1.5, 0.36, (0.90, 0.15, 0.15)),
    (1.5, -1.5, 0.36, (0.10, 0.55, 0.25)),
    (-0.5, 1.5, 0.36, (0.15, 0.30, 0.85)),
)
_TABLE = np.array([0.52, 0.40, 0.29], np.float32)
_BLACK, _WHITE = 0.08, 0.94
_ITERATIONS = 6  # of the inverse of the lens
_LEAST_SCALE = np.float32(0.3)  # of the lens, which cannot be inverted where it folds
_WIDEST = np.float32(2)  # tangent of the angle from the axis up to which the lens is inverted
_LEAST_EXTENT = 0.6  # of the squares of a target, in sides
_BEHIND = 0.05  # cosine between a ray and the normal of the board below which nothing is drawn

Plane = NDArray[np.float32]


class Lens(GeneratedTask):
    """A checkerboard of 8 x 6 squares on a table.

    Options
    -------
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 11 parameters are roll, tilt and pan in degrees; x, y and the distance of the board in
    squares; the focal length in sides of the image; k1, k2, p1, p2 of the lens, without units.

    `seed` chooses the target: the centers of the corner squares are in the picture.
    """

    name = "lens"
    least_change = 1e-4
    parameters = (
        Parameter("pose", "roll", "degrees", -180.0, 180.0),
        Parameter("pose", "tilt", "degrees", -35.0, 35.0),
        Parameter("pose", "pan", "degrees", -35.0, 35.0),
        Parameter("pose", "x", "squares", -3.0, 3.0),
        Parameter("pose", "y", "squares", -3.0, 3.0),
        Parameter("pose", "distance", "squares", 9.0, 18.0),
        Parameter("camera", "focal length", "sides", 1.1, 2.0),
        Parameter("lens", "k1", "1", -0.25, 0.25),
        Parameter("lens", "k2", "1", -0.1, 0.1),
        Parameter("lens", "p1", "1", -0.04, 0.04),
        Parameter("lens", "p2", "1", -0.04, 0.04),
    )

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        for v, frame in zip(values, out, strict=True):
            x, y = axes(*frame.shape[:2])
            u, v_, w, seen = on_board(v, x, y)
            _paint(frame, u, v_, w / min(frame.shape[:2]), seen)

    def _draw(self, rng: np.random.Generator) -> Vector:
        limit = np.array(half_extent(self.size))
        corners = np.array([(sx * (COLUMNS - 1) / 2, sy * (ROWS - 1) / 2, 0.0)
                            for sx in (-1, 1) for sy in (-1, 1)])  # fmt: skip
        low, width = self._range
        while True:
            x = rng.uniform(0.05, 0.95, self.dim)
            x_y = project(low + x * width, corners)
            covered = np.ptp(x_y, axis=0).max()
            if (np.abs(x_y) < limit).all() and covered > _LEAST_EXTENT:
                return x


def project(values: Vector, points: Vector) -> Vector:
    """Return where points of the board (n, 3) are seen, (n, 2) in sides; values: (11,)."""
    seen = points @ rotation(values).T + values[3:6]
    x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    k1, k2, p1, p2 = values[7:]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_d = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.asarray(values[6] * np.stack([x_d, y_d], axis=1))


def rotation(values: Vector) -> Vector:
    """Return R, (3, 3), of physical values (11,)."""
    (cr, ct, cp), (sr, st, sp) = (f(np.radians(values[:3])) for f in (np.cos, np.sin))
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    pan = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return np.asarray(roll @ tilt @ pan)


def on_board(values: Vector, x: Plane, y: Plane) -> tuple[Plane, Plane, float, NDArray[np.bool_]]:
    """Return which point of the board is seen where, the inverse of `project`.

    x, y: where, in sides, float32, broadcast to one shape. Returns u and v in squares, the width in
    squares of one side of the image at the distance of the board, and where the board's plane is
    before the camera.
    """
    x, y = _undistorted(x / np.float32(values[6]), y / np.float32(values[6]), values[7:])
    R, t = rotation(values), values[3:6]
    H = np.linalg.inv(np.column_stack([R[:, :2], t])).astype(np.float32)
    facing = (R[:, 2].astype(np.float32) * np.float32(math.copysign(1, R[:, 2] @ t))).tolist()
    q = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    seen = facing[0] * x + facing[1] * y + facing[2] > _BEHIND
    q = np.where(seen, q, np.float32(1))
    u, v = (H[i, 0] * x + H[i, 1] * y + H[i, 2] for i in (0, 1))
    return u / q, v / q, float(t[2] / values[6]), seen


def _undistorted(xd: Plane, yd: Plane, lens: Vector) -> tuple[Plane, Plane]:
    """Invert the lens: x <- (x_d - tangential(x)) / radial(x); lens: k1, k2, p1, p2."""
    k1, k2, p1, p2 = lens.astype(np.float32)
    x, y = np.broadcast_arrays(xd, yd)
    for _ in range(_ITERATIONS):
        x2, y2, xy = x * x, y * y, x * y
        r2 = x2 + y2
        scale = r2 * k2
        scale += k1
        scale *= r2
        scale += 1
        np.maximum(scale, _LEAST_SCALE, out=scale)
        xy *= 2
        x2 *= 2
        y2 *= 2
        x2 += r2  # r^2 + 2 x^2
        y2 += r2
        x, y = xd - p1 * xy, yd - p2 * xy
        x2 *= p2
        y2 *= p1
        x -= x2
        y -= y2
        x /= scale
        y /= scale
        np.clip(x, -_WIDEST, _WIDEST, out=x)  # beyond, in very wide images, it may diverge
        np.clip(y, -_WIDEST, _WIDEST, out=y)
    return x, y


def _paint(frame: Image, u: Plane, v: Plane, pixel: float, seen: NDArray[np.bool_]) -> None:
    """Paint the board; `pixel` is the width of a pixel in squares."""
    steep = np.float32(1 / pixel)
    squares = _wave(u, COLUMNS / 2, steep) * _wave(v, ROWS / 2, steep)
    inside = _box(u, v, COLUMNS / 2, ROWS / 2, steep)
    middle, half = (_WHITE + _BLACK) / 2, (_WHITE - _BLACK) / 2
    gray = np.float32(_WHITE) + inside * (np.float32(middle - _WHITE) + np.float32(half) * squares)
    board = np.repeat(gray[:, :, None], 3, axis=2)
    for x, y, radius, color in _DISCS:
        du, dv = u - np.float32(x), v - np.float32(y)
        distance = np.sqrt(du * du + dv * dv)
        disc = np.clip((np.float32(radius) - distance) * steep + np.float32(0.5), 0, 1)
        board += disc[:, :, None] * (np.array(color, np.float32) - board)
    paper = _box(u, v, COLUMNS / 2 + _BORDER, ROWS / 2 + _BORDER, steep) * seen
    frame[:] = _TABLE + paper[:, :, None] * (board - _TABLE)


def _wave(u: Plane, half: float, steep: np.float32) -> Plane:
    """Return 1 in even and -1 in odd squares, with an edge of a pixel between them."""
    within = np.clip(u, -half + 0.5 / steep, half - 0.5 / steep)
    within -= 2 * np.rint(within / 2 + np.float32(0.25)) - np.float32(0.5)  # in [-1, 1]
    triangle = np.float32(0.5) - np.abs(within)
    return np.asarray(np.clip(2 * steep * triangle, -1, 1))


def _box(u: Plane, v: Plane, half_u: float, half_v: float, steep: np.float32) -> Plane:
    """Return how much of each pixel is in the rectangle |u| < half_u, |v| < half_v."""
    a = np.clip((np.float32(half_u) - np.abs(u)) * steep + np.float32(0.5), 0, 1)
    return np.asarray(a * np.clip((np.float32(half_v) - np.abs(v)) * steep + np.float32(0.5), 0, 1))
