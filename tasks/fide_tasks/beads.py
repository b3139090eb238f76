"""Beads: six glass beads in the Cornell box, path traced (paper, Sec. 4.2 and S1)."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from fide_tasks.base import Parameter, Vector
from fide_tasks.mitsuba_task import MitsubaTask

_BEADS = 6
_RADIUS = 0.25  # half the side of the box is 1
_WALL = 1.0 - _RADIUS
_CEILING = 0.98  # the light hangs at 0.99
_APART = 2.2 * _RADIUS  # least distance of the centers in a generated target


class Beads(MitsubaTask):
    """Glass beads to be put where they are in the picture."""

    name = "beads"
    default_spp = 64
    default_max_depth = 8
    parameters = tuple(
        Parameter(f"bead {i + 1}", axis, "half sides", -_WALL, high)
        for i in range(_BEADS)
        for axis, high in (("x", _WALL), ("y", _CEILING - _RADIUS), ("z", _WALL))
    )

    def _scene(self, mi: Any) -> dict[str, Any]:
        box: dict[str, Any] = mi.cornell_box()
        del box["small-box"], box["large-box"], box["integrator"]
        glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
        for i in range(_BEADS):
            box[f"bead-{i}"] = {"type": "sphere", "bsdf": glass}
        return box

    def _update(self, mi: Any, params: Any, values: Vector) -> None:
        for i, center in enumerate(values.reshape(_BEADS, 3).tolist()):
            place = mi.Transform4f().translate(mi.Point3f(*center)).scale(_RADIUS)
            params[f"bead-{i}.to_world"] = place

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, _BEADS))
        low, width = self._range
        while True:
            x = rng.random(self.dim)
            centers = (low + x * width).reshape(_BEADS, 3)
            pairs = itertools.combinations(centers, 2)
            if all(np.linalg.norm(a - b) >= _APART for a, b in pairs):
                return x
