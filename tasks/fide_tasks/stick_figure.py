"""Stick figure: a person seen from the side, given by the angles of its joints.

The landscape folds: an elbow that bends the other way leads the hand to the same place, the near
limbs can take the places of the far ones, and a limb that overlaps nothing of its picture feels no
pull. The far limbs are a little darker than the near ones, so the answer is unique.

Notation: every bone starts where the one it hangs on ends, and turns with it. So the direction of a
bone is the sum of the angles from the hips to it, each a rest angle and the angle of a joint; 0 is
up and positive angles turn clockwise. Lengths are relative to the height of the figure.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Vector
from fide_tasks.generated import GeneratedTask, axes, half_extent, paint_limb

BONES = {  # name: (bone it hangs on, length, radius at its start and at its end)
    "belly": (None, 0.14, 0.055, 0.05),
    "chest": ("belly", 0.17, 0.05, 0.065),
    "head": ("chest", 0.13, 0.03, 0.065),
    "nose": ("head", 0.085, 0.025, 0.014),
    "far upper arm": ("chest", 0.16, 0.032, 0.026),
    "far forearm": ("far upper arm", 0.16, 0.026, 0.02),
    "near upper arm": ("chest", 0.16, 0.032, 0.026),
    "near forearm": ("near upper arm", 0.16, 0.026, 0.02),
    "far thigh": (None, 0.23, 0.048, 0.036),
    "far shin": ("far thigh", 0.23, 0.036, 0.024),
    "far foot": ("far shin", 0.09, 0.026, 0.018),
    "near thigh": (None, 0.23, 0.048, 0.036),
    "near shin": ("near thigh", 0.23, 0.036, 0.024),
    "near foot": ("near shin", 0.09, 0.026, 0.018),
}
_JOINTS = (  # bone that it turns, name, lowest and highest angle in degrees
    ("belly", "lean", -60.0, 60.0),
    ("chest", "spine", -45.0, 45.0),
    ("head", "neck", -45.0, 45.0),
    ("far upper arm", "far shoulder", -180.0, 180.0),
    ("far forearm", "far elbow", -150.0, 150.0),
    ("near upper arm", "near shoulder", -180.0, 180.0),
    ("near forearm", "near elbow", -150.0, 150.0),
    ("far thigh", "far hip", -110.0, 110.0),
    ("far shin", "far knee", -140.0, 140.0),
    ("far foot", "far ankle", -60.0, 60.0),
    ("near thigh", "near hip", -110.0, 110.0),
    ("near shin", "near knee", -140.0, 140.0),
    ("near foot", "near ankle", -60.0, 60.0),
)
_REST = {  # degrees, where the figure stands straight and looks to the right
    **dict.fromkeys(("far upper arm", "near upper arm", "far thigh", "near thigh"), 180.0),
    **dict.fromkeys(("far foot", "near foot"), -90.0),
    "nose": 90.0,
}
_PAINTING = (
    "far upper arm", "far forearm", "far thigh", "far shin", "far foot",
    "nose", "head", "belly", "chest",
    "near thigh", "near shin", "near foot", "near upper arm", "near forearm",
)  # fmt: skip
_COLORS = {
    name: np.array(rgb, np.float32)
    for names, rgb in (
        (("far upper arm", "far forearm"), (0.16, 0.34, 0.52)),
        (("near upper arm", "near forearm"), (0.30, 0.58, 0.84)),
        (("far thigh", "far shin"), (0.22, 0.24, 0.30)),
        (("near thigh", "near shin"), (0.42, 0.46, 0.58)),
        (("far foot",), (0.45, 0.20, 0.12)),
        (("near foot",), (0.80, 0.38, 0.20)),
        (("belly",), (0.40, 0.44, 0.56)),
        (("chest",), (0.90, 0.68, 0.22)),
        (("head", "nose"), (0.96, 0.74, 0.60)),
    )
    for name in names
}
_WALL = np.array([0.93, 0.94, 0.90], np.float32)
_FLOOR = np.array([0.80, 0.76, 0.68], np.float32)
_MARGIN = 0.04  # of joints of a target from the edge of the image, in sides

Point = tuple[float, float]


class StickFigure(GeneratedTask):
    """An articulated figure with round limbs before a wall.

    Options
    -------
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 16 parameters are x and y of the hips and the height in sides, then 13 angles in degrees:
    lean, spine, neck; far shoulder and elbow, near shoulder and elbow; far hip, knee and ankle,
    near hip, knee and ankle.

    `seed` chooses the pose of the target, all of which is in the picture.
    """

    name = "stick_figure"
    least_change = 1e-4

    def __init__(
        self, size: int | tuple[int, int] = 224, seed: int = 0, *, target: ArrayLike | None = None
    ) -> None:
        super().__init__(size, seed, target=target)
        across, down = half_extent(self.size)
        self.parameters = (
            Parameter("hips", "x", "sides", -0.6 * across, 0.6 * across),
            Parameter("hips", "y", "sides", -0.4 * down, 0.6 * down),
            Parameter("figure", "height", "sides", 0.6, 1.1),
            *(Parameter("joints", name, "degrees", low, high) for _, name, low, high in _JOINTS),
        )

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        height, width = out.shape[1:3]
        side = min(height, width)
        _, y = axes(height, width)
        floor = np.clip((y - np.float32(0.36)) * side + np.float32(0.5), 0, 1)[:, :, None]
        out[:] = _WALL + floor * (_FLOOR - _WALL)
        for v, frame in zip(values, out, strict=True):
            ends, scale = pose(v), side * float(v[2])
            for bone in _PAINTING:
                a, b = (_in_pixels(*end, height, width) for end in ends[bone])
                _, _, ra, rb = BONES[bone]
                paint_limb(frame, a, b, scale * ra, scale * rb, _COLORS[bone])

    def _draw(self, rng: np.random.Generator) -> Vector:
        limit = np.array(half_extent(self.size)) - _MARGIN
        low, width = self._range
        while True:
            x = rng.uniform(0.08, 0.92, self.dim)
            if (np.abs(np.array(list(pose(low + x * width).values()))) < limit).all():
                return x


def pose(values: Vector) -> dict[str, tuple[Point, Point]]:
    """Return where each bone starts and ends, (x, y) in sides, of physical values (16,)."""
    x, y, height, *angles = values.tolist()
    turns = {bone: angle for (bone, *_), angle in zip(_JOINTS, angles, strict=True)}
    direction: dict[str | None, float] = {None: 0.0}
    ends: dict[str, tuple[Point, Point]] = {}
    for bone, (parent, length, _, _) in BONES.items():
        direction[bone] = direction[parent] + _REST.get(bone, 0.0) + turns.get(bone, 0.0)
        angle = math.radians(direction[bone])
        start = (x, y) if parent is None else ends[parent][1]
        step = height * length * math.sin(angle), -height * length * math.cos(angle)
        ends[bone] = start, (start[0] + step[0], start[1] + step[1])
    return ends


def _in_pixels(x: float, y: float, height: int, width: int) -> Point:
    side = min(height, width)
    return x * side + width / 2, y * side + height / 2
