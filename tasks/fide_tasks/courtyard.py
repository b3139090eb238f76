"""The courtyard that the San Miguel task renders by default: 58,464 triangles from `courtyard.npz`.

Code made it, which is in the history of this file (until e300d0d4).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Mesh(NamedTuple):
    """Triangles with a normal and a color at each vertex; Y is up, lengths are in meters.

    vertices, normals: (v, 3).  colors: (v, 3), linear RGB in [0, 1].  faces: (f, 3), indices of
    vertices, counterclockwise seen from the front.
    """

    vertices: NDArray[np.float64]
    normals: NDArray[np.float32]
    colors: NDArray[np.float64]
    faces: NDArray[np.int32]


@cache
def courtyard() -> Mesh:
    """Return the courtyard; read once in a process, so do not write to it."""
    with np.load(Path(__file__).with_suffix(".npz"), allow_pickle=False) as file:
        mesh = Mesh(*(file[name] for name in Mesh._fields))
    # colors vary from place to place, and are darker near the ground
    p = mesh.vertices
    mottle = 0.06 * _waves(p, 1.9) + 0.05 * _waves(p, 5.3)
    damp = 1 - 0.12 * np.exp(-np.maximum(p[:, 1], 0) / 0.4)
    weathered = np.clip(mesh.colors * ((1 + mottle) * damp)[:, None], 0.0, 1.0)
    return mesh._replace(colors=weathered)


def _waves(p: NDArray[np.float64], frequency: float) -> NDArray[np.float64]:
    """Smooth variation in [-1, 1] over space, (v,)."""
    x, y, z = (frequency * p).T
    waves: NDArray[np.float64] = (
        np.sin(1.3 * x + 2.1 * np.sin(0.7 * z)) + np.sin(1.1 * z + 1.7 * np.sin(0.9 * y + 0.4 * x))
    ) / 2
    return waves
