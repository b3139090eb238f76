"""San Miguel: a camera and a light that are lost in a courtyard (paper, Sec. 4.2 and S1).

The paper renders the San Miguel scene with light of a single bounce. Here a courtyard of our own
(`fide_tasks.courtyard`) stands in for it.

Notation: the camera is at o in meters and looks along
(sin theta cos phi, cos theta, sin theta sin phi), Y being up; the light is at l in meters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_tasks import viewpoints
from fide_tasks.base import Parameter, Vector
from fide_tasks.courtyard import courtyard
from fide_tasks.mitsuba_task import MitsubaTask

_PLACE = (("x", 7.0, 25.0), ("y", 1.0, 10.0), ("z", -2.0, 12.0))  # m; the paper's bounds
_THETA = (45.0, 135.0)  # degrees from straight up; the paper gives bounds of positions only
_FOV = 65.0  # degrees, across the shorter side of the image
_INTENSITY = (190.0, 148.0, 100.0)  # W/sr of the point light, a warm white
_ZENITH, _HORIZON = (0.15, 0.23, 0.43), (0.70, 0.50, 0.40)  # radiance of the sky at dusk
_GLOW = (0.07, 0.065, 0.065)  # radiance of surfaces, times their color; see `_court`


class SanMiguel(MitsubaTask):
    """A camera (position and two angles) and a point light (position) in a courtyard.

    The 8 parameters are x, y, z of the camera, the angles theta and phi of the direction in which
    it looks, and x, y, z of the light. Positions are in the paper's bounds, x [7, 25], y [1, 10],
    z [-2, 12]; theta, measured from straight up, is in [45, 135] degrees, since steeper views are
    mostly floor or sky; phi goes all around, so that phi = 0 and phi = 1 give the same image. The
    camera is never tilted sideways.

    With max_depth = 2, the default, it is the paper's direct light, under a dusk sky; surfaces
    shine a little by themselves, in place of light that bounces between them. Any other max_depth
    is path traced, without that.

    A generated target depends on `seed`. Its camera has room before it, and much of
    what it sees is lit.
    """

    name = "san_miguel"
    default_spp = 8
    default_max_depth = 2
    default_reference_spp = 256
    parameters = (
        *(Parameter("camera", name, "m", low, high) for name, low, high in _PLACE),
        Parameter("camera", "theta", "deg", *_THETA),
        Parameter("camera", "phi", "deg", 0.0, 360.0, periodic=True),
        *(Parameter("light", name, "m", low, high) for name, low, high in _PLACE),
    )

    def _integrator(self) -> dict[str, Any]:
        if self.max_depth == 2:
            return {"type": "direct", "emitter_samples": 1, "bsdf_samples": 1}
        return super()._integrator()

    def _scene(self, mi: Any) -> dict[str, Any]:
        return {
            "type": "scene",
            "light": {"type": "point", "intensity": {"type": "rgb", "value": _INTENSITY}},
            "sky": _sky(mi),
            "court": _court(mi, glows=self.max_depth == 2),
            "sensor": {
                "type": "perspective",
                "fov": _FOV,
                "fov_axis": "smaller",
                "near_clip": 0.05,
            },
        }

    def _update(self, mi: Any, params: Any, values: Vector) -> None:
        right, up, forward = viewpoints.axes(values[3], values[4])
        pose = np.eye(4)
        pose[:3] = np.column_stack([-right, up, forward, values[:3]])
        params["sensor.to_world"] = mi.Transform4f(pose)
        params["light.position"] = mi.Point3f(*values[5:].tolist())

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, self.dim))
        low, width = self._range
        with self.open():
            v = viewpoints.choose(rng, low, low + width, self._cast, _FOV)
        x: Vector = (v - low) / width
        return x

    def _cast(self, origins: Vector, directions: Vector) -> tuple[Vector, Vector]:
        """Follow rays to the first surfaces; see `viewpoints.Cast`. The scene must be open."""
        assert self._loaded is not None
        return _first_hits(self._loaded.mi, self._loaded.scene, origins, directions)


def _court(mi: Any, glows: bool) -> Any:
    """The courtyard as Mitsuba's mesh; no ray is spent on finding its glow."""
    mesh = courtyard()
    properties = mi.Properties()
    color = {"type": "mesh_attribute", "name": "vertex_color"}
    properties["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
    )
    if glows:
        own = {"type": "mesh_attribute", "name": "vertex_glow"}
        properties["emitter"] = mi.load_dict(
            {"type": "area", "radiance": own, "sampling_weight": 0.0}
        )
    shape = mi.Mesh(
        "courtyard", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties
    )
    shape.add_attribute("vertex_color", 3, _flat(mesh.colors))
    shape.add_attribute("vertex_glow", 3, _flat(mesh.colors * _GLOW))
    params = mi.traverse(shape)
    params["vertex_positions"] = _flat(mesh.vertices)
    params["vertex_normals"] = _flat(mesh.normals)
    params["faces"] = mesh.faces.ravel().astype(np.uint32)
    params.update()
    return shape


def _flat(values: NDArray[Any]) -> NDArray[np.float32]:
    return values.ravel().astype(np.float32)


def _sky(mi: Any) -> dict[str, Any]:
    """A sky that brightens toward the horizon; surfaces find it by the rays they scatter."""
    height = np.cos(np.linspace(0, np.pi, 32))[:, None, None].clip(0, 1) ** 0.5
    radiance = height * _ZENITH + (1 - height) * _HORIZON
    bitmap = mi.Bitmap(np.repeat(radiance, 64, axis=1).astype(np.float32))
    return {"type": "envmap", "bitmap": bitmap, "sampling_weight": 0.0}


def _first_hits(mi: Any, scene: Any, origins: Vector, directions: Vector) -> tuple[Vector, Vector]:
    """Follow rays to the first surfaces: distances (n,), inf for none, and normals (n, 3)."""
    if mi.variant().startswith("scalar"):
        hits = [
            scene.ray_intersect(mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)))
            for o, d in zip(origins.tolist(), directions.tolist(), strict=True)
        ]
        return np.array([h.t for h in hits]), np.array([[*h.n] for h in hits], np.float64)
    o, d = (np.ascontiguousarray(a.T, np.float32) for a in (origins, directions))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    return np.array(hit.t, np.float64), np.array(hit.n, np.float64).T
