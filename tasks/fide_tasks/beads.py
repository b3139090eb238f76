"""Beads: six glass beads in the Cornell box, path traced (paper, Sec. 4.2 and S1).

The beads refract and mirror the box and each other, gather the light of the area lamp to caustics
and cast shadows, so that every one of them shows in places where it is not.

Notation: center c [3] of a bead as (x, y, z), radius r, in half sides of the box: its walls are at
-1 and 1, x to the right as the camera sees it, y up, z towards the camera, where the box is open.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from fide_tasks.base import Parameter, Vector
from fide_tasks.mitsuba_task import MitsubaTask

_BEADS = 6
_RADIUS = 0.25
_GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
_WALL = 1.0 - _RADIUS
_CEILING = 0.98 - _RADIUS  # the lamp hangs at 0.99
_CAMERA_Z = 3.9
_APART = 2.2  # least distance of the centers in a generated target, in radii
_IN_SIGHT = 0.8  # least distance of the beads on the screen, relative to the sum of their radii


class Beads(MitsubaTask):
    """Glass beads of one size, to be put where they are in the picture.

    The 18 parameters are x, y, z of each bead, from wall to wall less the radius of 1/4 (and below
    the lamp), so that no bead is ever cut by a wall. Beads may overlap each other: each surface
    then refracts as if there were air outside, which no glass does, but the image stays valid and
    varies continuously. Swapping two beads leaves the image unchanged, so there are 6! optima.

    The scene is Mitsuba's own Cornell box without its two boxes. By default 64 samples per pixel of
    at most 8 segments: longer paths carry 6 % of the light and would take 15 % more time.

    The x_star of a generated target depends on `seed` alone, its picture on the size and all other
    options: it is rendered with `reference_spp` samples per pixel, so it has some noise, too. Its
    beads keep 1.1 diameters apart, and none hides another one.

    Compare pictures by `perceptual`, with 16 paths or more. Each bead adds noise, and mse counts
    that: on some targets six beads in one place, which are one bead to see, have a lower mse than
    the true ones.

    One frame takes about 1 s at 224 x 224 on the LLVM variant and two cores.
    """

    name = "beads"
    alike = "bead"
    default_spp = 64
    default_max_depth = 8
    parameters = tuple(
        Parameter(f"bead {i + 1}", axis, "half sides", -_WALL, high)
        for i in range(_BEADS)
        for axis, high in (("x", _WALL), ("y", _CEILING), ("z", _WALL))
    )

    def _scene(self, mi: Any) -> dict[str, Any]:
        scene: dict[str, Any] = mi.cornell_box()
        for part in ("small-box", "large-box", "integrator"):
            del scene[part]
        for i in range(_BEADS):
            scene[f"bead-{i}"] = {"type": "sphere", "bsdf": _GLASS}
        return scene

    def _update(self, mi: Any, params: Any, values: Vector) -> None:
        for i, c in enumerate(values.reshape(_BEADS, 3).tolist()):
            place = mi.Transform4f().translate(mi.Point3f(*c)).scale(_RADIUS)
            params[f"bead-{i}.to_world"] = place

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, _BEADS))
        while True:  # one draw in sixty passes
            x = rng.random(self.dim)
            if _well_apart(self._physical(x).reshape(_BEADS, 3)):
                return x


def _well_apart(centers: Vector) -> bool:
    """Whether no beads at the centers, (n, 3), touch or hide one another."""
    for a, b in itertools.combinations(centers, 2):
        near, far = _CAMERA_Z - a[2], _CAMERA_Z - b[2]
        shift = np.linalg.norm(a[:2] / near - b[:2] / far)
        if np.linalg.norm(a - b) < _APART * _RADIUS:
            return False
        if shift < _IN_SIGHT * (_RADIUS / near + _RADIUS / far):
            return False
    return True
