"""Arm: a robot arm with a gripper on a tiled floor, seen by a fixed camera in perspective.

The landscape folds as that of `robot` does, which needs MuJoCo and takes longer: from most poses an
elbow can go over or under, and the wrist can flip. A fin on the base and a lamp on the forearm show
where the yaw and the roll are, and one finger is red; so the answer is unique.

Notation: z is up, lengths are in meters. Link i has the frame
F_i = F_(i-1) T(0, 0, l_(i-1)) R(q_i), whose z axis points along it; R turns about z
for yaw and roll, about y for the other joints.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image, Parameter, Vector
from fide_tasks.generated import GeneratedTask, axes, cast_shadow, paint_limb

JOINTS = (  # name, axis, lowest and highest angle in degrees, length to the next joint
    ("base yaw", "z", -170.0, 170.0, 0.35),
    ("shoulder", "y", -100.0, 100.0, 0.50),
    ("elbow", "y", -140.0, 140.0, 0.24),
    ("forearm roll", "z", -170.0, 170.0, 0.20),
    ("wrist", "y", -115.0, 115.0, 0.16),
    ("hand roll", "z", -170.0, 170.0, 0.06),
)
_OPENING = (0.02, 0.24)  # of the gripper, in meters
_FINGER = 0.16
_EYE, _LOOK_AT = np.array([1.9, -2.1, 1.5]), np.array([0.0, 0.0, 0.60])
_FOCAL = 1.25  # focal length in sides of the image
_LIGHT = np.array([0.35, 0.25, -1.0])  # where light goes
_SHADOW = 0.45  # part of the light that a shadow takes
_SHADOW_EDGE = 0.03  # of its width in sides
_TILE = 0.4
_LOWEST = 0.06  # of a joint of a target above the floor
_MARGIN = 0.03  # of a joint of a target from the edge of the image, in sides

_RODS = {  # name: radius at the start and at the end in meters, color
    name: (ra, rb, np.array(rgb, np.float32))
    for name, ra, rb, rgb in (
        ("fin", 0.05, 0.03, (0.95, 0.80, 0.25)),
        ("column", 0.13, 0.09, (0.35, 0.37, 0.42)),
        ("upper arm", 0.085, 0.07, (0.95, 0.52, 0.15)),
        ("forearm", 0.07, 0.06, (0.92, 0.90, 0.86)),
        ("wrist", 0.055, 0.05, (0.70, 0.72, 0.78)),
        ("hand", 0.05, 0.045, (0.95, 0.52, 0.15)),
        ("flange", 0.05, 0.05, (0.35, 0.37, 0.42)),
        ("palm", 0.03, 0.03, (0.35, 0.37, 0.42)),
        ("left finger", 0.026, 0.02, (0.85, 0.18, 0.18)),
        ("right finger", 0.026, 0.02, (0.30, 0.32, 0.36)),
        ("lamp", 0.035, 0.045, (0.20, 0.62, 0.95)),
    )
}
_FIXED = 2  # of the rods, which never leave their places: fin and column
_FIN, _LAMP = (0.06, 0.26), 0.13  # height and length of the fin, length of the lamp, in meters
_RADII = np.array([(ra, rb) for ra, rb, _ in _RODS.values()])

Seen = tuple[list[float], list[float], float, float, float]


class Arm(GeneratedTask):
    """A robot arm of six joints and a gripper.

    Options
    -------
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 7 parameters are the angles of the joints in degrees, from the base to the hand, and how far
    the gripper is open in meters.

    `seed` chooses the pose of the target: above the floor, and all in the picture.
    """

    name = "arm"
    least_change = 1e-4
    parameters = (
        *(Parameter(f"joint {i + 1}", n, "degrees", low, high)
          for i, (n, _, low, high, _) in enumerate(JOINTS)),
        Parameter("gripper", "opening", "m", *_OPENING),
    )  # fmt: skip

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        shape = out.shape[1], out.shape[2]
        floor, is_floor = _floor(*shape)
        soft = max(1.0, _SHADOW_EDGE * min(shape))
        for v, frame in zip(values, out, strict=True):
            arm = rods(v)
            shadow = np.zeros(shape, np.float32)
            for a, b, ra, rb, _ in _in_pixels(_on_floor(arm), shape):
                cast_shadow(shadow, a, b, ra, rb, soft)
            np.multiply(shadow, is_floor, out=shadow)
            np.multiply(floor, 1 - np.float32(_SHADOW) * shadow[:, :, None], out=frame)
            seen = zip(_in_pixels(arm, shape), _RODS.values(), strict=True)
            for (a, b, ra, rb, _), rod in sorted(seen, key=lambda item: -item[0][4]):
                paint_limb(frame, a, b, ra, rb, rod[2])

    def _draw(self, rng: np.random.Generator) -> Vector:
        low, width = self._range
        while True:
            x = rng.uniform(0.06, 0.94, self.dim)
            moving = rods(low + x * width)[_FIXED:, :].reshape(-1, 3)
            x_y, _ = project(moving)
            if moving[:, 2].min() > _LOWEST and np.abs(x_y).max() < 0.5 - _MARGIN:
                return x


def rods(values: Vector) -> Vector:
    """Return where the parts of the arm start and end in the world, (n, 2, 3) in meters.

    They are the fin, the links from the column to the hand, the palm, the left and the right
    finger, and the lamp; values: (7,), physical.
    """
    places, frames = forward_kinematics(values[:-1])
    tip, across, along = places[-1], frames[-1, :, 0], frames[-1, :, 2]
    left, right = (tip + sign * values[-1] / 2 * across for sign in (1, -1))
    edge = (_OPENING[1] / 2) * across
    middle = (places[3] + places[4]) / 2
    fin = np.array([0.0, 0.0, _FIN[0]])
    ends = [fin, fin + _FIN[1] * frames[0, :, 0]]
    for i in range(len(JOINTS)):
        ends += [places[i], places[i + 1]]
    ends += [tip - edge, tip + edge, left, left + _FINGER * along, right, right + _FINGER * along]
    ends += [middle, middle + _LAMP * frames[3, :, 0]]
    return np.array(ends).reshape(-1, 2, 3)


def forward_kinematics(angles: Vector) -> tuple[Vector, Vector]:
    """Return where the joints and the tip are, (7, 3), and the axes of the links, (6, 3, 3).

    The columns of axes[i] are the x, y and z axis of the frame F_i; angles: (6,) in degrees.
    """
    place, axes_ = np.zeros(3), np.eye(3)
    places, frames = [place], []
    for (_, axis, _, _, length), angle in zip(JOINTS, np.radians(angles).tolist(), strict=True):
        axes_ = axes_ @ _rotation(axis, angle)
        place = place + length * axes_[:, 2]
        places.append(place)
        frames.append(axes_)
    return np.array(places), np.array(frames)


def project(points: Vector) -> tuple[Vector, Vector]:
    """Return where the camera sees points (n, 3): (x, y) in sides, (n, 2), and depth in m, (n,)."""
    seen = (points - _EYE) @ _camera().T
    return _FOCAL * seen[:, :2] / seen[:, 2:], seen[:, 2]


def _rotation(axis: str, angle: float) -> Vector:
    c, s = math.cos(angle), math.sin(angle)
    if axis == "z":
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@cache
def _camera() -> Vector:
    """Return the camera's axes as rows: right, down, forward."""
    forward = (_LOOK_AT - _EYE) / np.linalg.norm(_LOOK_AT - _EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _on_floor(points: Vector) -> Vector:
    """Return where the shadows of points (..., 3) fall."""
    height = np.maximum(points[..., 2:], 0)
    return np.asarray(points - height / _LIGHT[2] * _LIGHT)


def _in_pixels(ends: Vector, shape: tuple[int, int]) -> list[Seen]:
    """Return the ends (x, y) of rods and their radii in pixels, and the depth of their middles."""
    x_y, depth = project(ends.reshape(-1, 3))
    x_y = (x_y * min(shape) + (shape[1] / 2, shape[0] / 2)).reshape(-1, 2, 2)
    radii = _RADII * (_FOCAL * min(shape)) / depth.reshape(-1, 2)
    middles = depth.reshape(-1, 2).mean(axis=1)
    return [
        (a, b, ra, rb, middle)
        for (a, b), (ra, rb), middle in zip(
            x_y.tolist(), radii.tolist(), middles.tolist(), strict=True
        )
    ]


@cache
def _floor(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the scene without an arm, (H, W, 3), and how much of each pixel is floor, (H, W)."""
    x, y = (a.astype(np.float64) for a in axes(height, width))
    x, y = np.broadcast_arrays(x / _FOCAL, y / _FOCAL)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ _camera()
    down = np.maximum(-rays[:, :, 2], 1e-3)
    distance = _EYE[2] / down
    place = (_EYE + rays * distance[:, :, None])[:, :, :2] / _TILE
    soft = distance / (_FOCAL * min(height, width) * _TILE)  # a pixel in tiles, across
    wave = 1 - 2 * np.abs(np.mod(place, 2) - 1)  # triangular, 0 at the joints
    u, v = np.clip(wave / np.maximum(soft, 1e-6)[:, :, None], -1, 1).transpose(2, 0, 1)
    fade = np.clip(1.2 - 0.6 * soft / down, 0, 1)  # tiles narrower than a few pixels blend
    tone = 0.70 + 0.05 * u * v * fade
    is_floor = np.clip((-rays[:, :, 2]) * 40, 0, 1)
    sky = np.array([0.80, 0.87, 0.93]) - 0.15 * np.clip(y + 0.5, 0, 1)[:, :, None]
    tiles = tone[:, :, None] * np.array([1.0, 0.97, 0.92])
    image = is_floor[:, :, None] * tiles + (1 - is_floor[:, :, None]) * sky
    return image.astype(np.float32), is_floor.astype(np.float32)
