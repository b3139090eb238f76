"""Ball: a glossy ball under three lights of fixed colors; a smooth scene of few parameters.

Every parameter moves the image smoothly and everywhere, and there is one basin in most targets. So
solvers of least-squares problems do well here, and it tells what a search costs beside them.

Notation: unit normals n of the ball, seen from z; a light has the direction l and the power p, and
adds p c (d ((1 + n l) / 2)^2 + s exp(g (n h - 1))) to the radiance, c its color, h the unit vector
halfway between l and z.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image, Parameter, Vector
from fide_tasks.generated import GeneratedTask, axes

_RADIUS = 0.42  # in sides
_DIFFUSE, _GLOSS, _SHARPNESS = 0.5, 0.6, 25.0
_LIGHTS = {
    "warm light": (1.0, 0.45, 0.15),
    "cold light": (0.12, 0.40, 1.0),
    "green light": (0.30, 0.90, 0.20),
}
_COLORS = np.array(list(_LIGHTS.values()), np.float32)
_BACKGROUND = np.array([0.10, 0.10, 0.13], np.float32)

Plane = NDArray[np.float32]


class Ball(GeneratedTask):
    """A ball under a warm, a cold and a green light.

    Options
    -------
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 10 parameters are azimuth (-80 to 80 degrees, positive from the right), elevation (-60 to 60
    degrees) and power (0 to 1.5) of each light, then ambient light (0 to 0.3).
    """

    name = "ball"
    parameters = (
        *(
            Parameter(light, *kind)
            for light in _LIGHTS
            for kind in (
                ("azimuth", "degrees", -80.0, 80.0),
                ("elevation", "degrees", -60.0, 60.0),
                ("power", "1", 0.0, 1.5),
            )
        ),
        Parameter("room", "ambient", "0-1", 0.0, 0.3),
    )

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        shape = out.shape[1], out.shape[2]
        normals, covered = _ball(*shape)
        for v, frame in zip(values, out, strict=True):
            lights = v[:-1].reshape(3, 3)
            shades = np.stack([_shade(normals, *light) for light in lights.tolist()])
            radiance = (shades.T @ _COLORS).reshape(frame.shape) + np.float32(v[-1])
            surface = 1 - np.exp(np.float32(-1.5) * radiance)
            frame[:] = _BACKGROUND + covered * (surface - _BACKGROUND)

    def _draw(self, rng: np.random.Generator) -> Vector:
        return rng.uniform(0.15, 0.85, self.dim)


def direction(azimuth: float, elevation: float) -> Vector:
    """Return the unit vector toward a light (x right, y down, z to the camera); in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), -math.sin(e), math.cos(a) * math.cos(e)])


def _shade(normals: Plane, azimuth: float, elevation: float, power: float) -> Plane:
    """Return what a white light adds at each pixel, (H W,); normals: (H W, 3)."""
    light = direction(azimuth, elevation)
    half = light + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    lit = np.float32(0.5) * (normals @ light.astype(np.float32)) + np.float32(0.5)
    gloss = np.exp(np.float32(_SHARPNESS) * (normals @ half.astype(np.float32) - 1))
    shade = np.float32(_DIFFUSE) * lit * lit + np.float32(_GLOSS) * gloss
    return np.asarray(np.float32(power) * shade)


@cache
def _ball(height: int, width: int) -> tuple[Plane, Plane]:
    """Return the normals, (H W, 3), and how much of each pixel is ball, (H, W, 1)."""
    x, y = (a / np.float32(_RADIUS) for a in axes(height, width))
    x, y = np.broadcast_arrays(x, y)
    r = np.hypot(x, y)
    scale = 1 / np.maximum(r, 1)
    z = np.sqrt(np.maximum(1 - r * r, 0))
    normals = np.stack([x * scale, y * scale, z], axis=2).reshape(-1, 3)
    covered = np.clip((1 - r) * (_RADIUS * min(height, width)) + 0.5, 0, 1)
    return normals.astype(np.float32), covered[:, :, None].astype(np.float32)
