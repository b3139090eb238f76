"""A courtyard made by code: the scene that the San Miguel task renders by default.

Two storeys of arcades around a paved court, with stairs, a fountain, tables and chairs, plants, a
tiled roof and a bell tower. Everything is computed from a few numbers in `plan.py`, the same in
every process; nothing is loaded, and nothing but NumPy is needed.

    >>> from fide_tasks.courtyard import courtyard
    >>> courtyard().faces.shape[1]
    3
"""

from __future__ import annotations

from functools import cache

import numpy as np

from fide_tasks.courtyard import building, court, plan
from fide_tasks.courtyard.mesh import Array, Mesh, join

__all__ = ["Mesh", "courtyard"]


@cache
def courtyard() -> Mesh:
    """Return the courtyard as one mesh; built once in a process, so do not write to it."""
    parts = [
        *court.paving(),
        court.stairs(),
        building.tower(),
        court.fountain(),
        *court.tables(),
        *court.flags(),
        *court.trees(),
        court.climber(),
    ]
    for side in plan.SIDES:
        local = [
            *building.arcade(side),
            *building.walls(side),
            *building.roof(side),
            *court.walk(side),
            *court.pots(side),
        ]
        parts += [part.placed(*side.frame) for part in local]
    return _weathered(join(parts))


def _weathered(mesh: Mesh) -> Mesh:
    """Vary the colors from place to place, and darken what is near the ground."""
    p = mesh.vertices
    mottle = 0.06 * _waves(p, 1.9) + 0.05 * _waves(p, 5.3)
    damp = 1 - 0.12 * np.exp(-np.maximum(p[:, 1], 0) / 0.4)
    return mesh.tinted(((1 + mottle) * damp)[:, None])


def _waves(p: Array, frequency: float) -> Array:
    """Smooth variation in [-1, 1] over space, (v,)."""
    x, y, z = (frequency * p).T
    waves: Array = (
        np.sin(1.3 * x + 2.1 * np.sin(0.7 * z)) + np.sin(1.1 * z + 1.7 * np.sin(0.9 * y + 0.4 * x))
    ) / 2
    return waves
