"""The two storeys of arcades: columns, round arches, floors, beams, balustrades, lanterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, arch, at_depth, box, join, lathe, quads, strip
from fide_tasks.courtyard.plan import Side

_HALF = 0.22  # half the thickness of the arcade wall
_PIER = 0.25  # half the width of wall that stands on a column
_ARCH_PARTS = 12
_SPRING_LOW, _TOP_LOW = 3.0, 4.4  # springing line and top of the wall, ground floor
_SPRING_HIGH, _TOP_HIGH = 7.0, plan.EAVES - 0.1
_STAIR_BAY = 6  # of the north side: its balustrade is open toward the stairs


def arcade(side: Side) -> list[Mesh]:
    """One side of the court: what stands on its edge and over the walk behind it."""
    parts = [_column_row(side), *_floors(side), *_beams(side)]
    for bay in range(side.bays):
        left = bay * side.bay
        parts.append(_arch_bay(side.bay, _SPRING_LOW, _TOP_LOW, plan.CREAM).placed((left, 0, 0)))
        parts.append(_arch_bay(side.bay, _SPRING_HIGH, _TOP_HIGH, plan.ROSE).placed((left, 0, 0)))
        parts.append(_lantern().placed((left + side.bay / 2, 0, -1.5)))
        if not (side.name == "north" and bay == _STAIR_BAY):
            parts.append(_balustrade(side.bay).placed((left, plan.GALLERY, 0)))
    return parts


def _column(height: float, radius: float) -> Mesh:
    """A column on a square base under a square block, together `height` tall."""
    r, top = radius, height - 0.13
    profile = [
        (1.35 * r, 0.14),
        (1.42 * r, 0.19),
        (1.3 * r, 0.25),
        (1.0 * r, 0.3),
        (0.98 * r, height * 0.4),
        (0.84 * r, top - 0.3),
        (1.0 * r, top - 0.27),
        (0.86 * r, top - 0.22),
        (0.9 * r, top - 0.14),
        (1.4 * r, top),
    ]
    base, block = 1.5 * r, 1.6 * r
    return join(
        [
            box((-base, 0, -base), (base, 0.14, base), plan.CANTERA_DARK, "y"),
            lathe(profile, 10, plan.CANTERA),
            box((-block, top, -block), (block, height, block), plan.CANTERA),
        ]
    )


def _pier(height: float) -> Mesh:
    """A square corner pier with a base and a capital."""
    return join(
        [
            box((-0.34, 0, -0.34), (0.34, 0.3, 0.34), plan.CANTERA_DARK, "y"),
            box((-0.28, 0.3, -0.28), (0.28, height - 0.25, 0.28), plan.CANTERA, "yY"),
            box((-0.33, height - 0.25, -0.33), (0.33, height, 0.33), plan.CANTERA),
            box((-0.28, height, -0.28), (0.28, height + 1.9, 0.28), plan.CANTERA, "yY"),
        ]
    )


def _column_row(side: Side) -> Mesh:
    """The columns of both storeys, and the corner piers at this side's left end."""
    low, high = _SPRING_LOW - plan.PLINTH, _SPRING_HIGH - plan.GALLERY
    parts = [_pier(low).placed((0, plan.PLINTH, 0)), _pier(high).placed((0, plan.GALLERY, 0))]
    for i in range(1, side.bays):
        parts.append(_column(low, 0.2).placed((i * side.bay, plan.PLINTH, 0)))
        parts.append(_column(high, 0.16).placed((i * side.bay, plan.GALLERY, 0)))
    return join(parts)


def _arch_bay(width: float, spring: float, top: float, plaster: ArrayLike) -> Mesh:
    """The wall over one bay, from the springing line up, with its round opening.

    Only what faces the court: no camera in it sees the back.
    """
    radius = width / 2 - _PIER
    curve = arch(_ARCH_PARTS, (width / 2, spring), radius)
    edge = np.vstack([[width, spring], curve, [0, spring]])  # right to left
    sky = np.column_stack([edge[:, 0], np.full(len(edge), top)])
    front, back = at_depth(edge, _HALF), at_depth(edge, -_HALF)
    return join(
        [
            strip(front[::-1], at_depth(sky, _HALF)[::-1], plaster),
            strip(front[1:-1], back[1:-1], plan.CANTERA),
            _voussoirs(curve, radius, (width / 2, spring)),
        ]
    )


def _voussoirs(rim: Array, radius: float, center: tuple[float, float]) -> Mesh:
    """The ring of stones, of two tones in turn, that stands out around an arch."""
    outer = arch(_ARCH_PARTS, center, radius + 0.2)
    tone = np.arange(_ARCH_PARTS) % 2
    stones = np.stack([plan.CANTERA, plan.CANTERA_DARK])[tone]
    near = _HALF + 0.04
    return join(
        [
            strip(at_depth(rim, near)[::-1], at_depth(outer, near)[::-1], stones[::-1]),
            strip(at_depth(outer, _HALF), at_depth(outer, near), stones),
            strip(at_depth(rim, near), at_depth(rim, _HALF), stones),
        ]
    )


def _floors(side: Side) -> list[Mesh]:
    """The cornices along the edge, the gallery's floor and the ceilings behind."""
    u0, u1, back = -side.reach, side.length + side.reach, -plan.DEPTH
    ends = side.length + 0.3
    return [
        box((-0.3, _TOP_LOW, -0.3), (ends, 4.55, 0.3), plan.CANTERA),
        box((-0.36, 4.55, -0.3), (ends + 0.06, plan.GALLERY, 0.36), plan.CANTERA_DARK),
        quads([(u0, 4.69, 0), (u1, 4.69, 0), (u1, 4.69, back), (u0, 4.69, back)], plan.BRICK),
        quads([(u0, 4.4, back), (u1, 4.4, back), (u1, 4.4, 0), (u0, 4.4, 0)], plan.CREAM),
        box((-0.28, _TOP_HIGH - 0.14, -0.26), (ends, _TOP_HIGH, 0.3), plan.CANTERA),
        quads([(u0, 8.7, back), (u1, 8.7, back), (u1, 8.7, 0), (u0, 8.7, 0)], plan.CREAM),
    ]


def _beams(side: Side) -> list[Mesh]:
    """Wooden beams across the walk under both ceilings, and the floor tiles of the walk."""
    beam = box((-0.07, -0.2, -plan.DEPTH), (0.07, 0.0, -_HALF), plan.DARK_WOOD, "YzZ")
    count = side.bays * 3
    places = (np.arange(count) + 0.5) * (side.length / count)
    low = [beam.placed((u, 4.4, 0)) for u in places.tolist()]
    high = [beam.placed((u, 8.7, 0)) for u in places.tolist()]
    return low + high


def _balustrade(width: float) -> Mesh:
    """Turned stone balusters between two columns under a rail."""
    profile = [(0.05, 0.08), (0.085, 0.3), (0.045, 0.6), (0.07, 0.78)]
    baluster = lathe(profile, 6, plan.CANTERA)
    count = 6
    places = 0.3 + (width - 0.6) * (np.arange(count) + 0.5) / count
    left, right = 0.16, width - 0.16
    return join(
        [
            *(baluster.placed((u, 0, 0)) for u in places.tolist()),
            box((left, 0, -0.11), (right, 0.08, 0.11), plan.CANTERA_DARK, "xXy"),
            box((left, 0.78, -0.13), (right, 0.93, 0.13), plan.CANTERA, "xX"),
        ]
    )


def _lantern() -> Mesh:
    """A hexagonal lantern on a chain from the ceiling of the walk."""
    glass = [(0.1, 2.95), (0.16, 3.3)]
    cap = [(0.2, 3.3), (0.0, 3.5)]
    return join(
        [
            lathe(glass, 6, plan.YELLOW, faceted=True),
            lathe(cap, 6, plan.IRON, faceted=True),
            lathe([(0.0, 2.88), (0.1, 2.95)], 6, plan.IRON, faceted=True),
            lathe([(0.012, 3.5), (0.012, 4.4)], 4, plan.IRON),
        ]
    )
