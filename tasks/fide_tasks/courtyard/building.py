"""The two storeys around the court: arcades, the walls behind them, roof and bell tower."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import (
    Array,
    Mesh,
    arch,
    at_depth,
    box,
    fan,
    join,
    lathe,
    quads,
    strip,
)
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


# -- walls: mottled plaster, painted feet, doors and windows ---------------------------------------


_DOORS = (plan.TEAL, plan.WOOD, plan.BLUE, plan.DARK_WOOD, plan.GREEN)
_SHUTTERS = (plan.BLUE, plan.TEAL, plan.WOOD, plan.GREEN)


def walls(side: Side) -> list[Mesh]:
    """The wall of one side on both storeys with an opening in every bay."""
    rng = np.random.default_rng((1, side.bays, len(side.name), ord(side.name[0])))
    back = (0.0, 0.0, -plan.DEPTH)
    parts = [
        _plaster(side, plan.PLINTH, 1.3, plan.DADO),
        _plaster(side, 1.3, 4.4, plan.OCHRE),
        _plaster(side, plan.GALLERY - 0.01, 5.5, plan.OCHRE),
        _plaster(side, 5.5, 8.7, plan.ROSE),
    ]
    for bay in range(side.bays):
        middle = (bay + 0.5) * side.bay
        color = _DOORS[rng.integers(len(_DOORS))]
        shutter = _SHUTTERS[rng.integers(len(_SHUTTERS))]
        low = door(color) if rng.random() < 0.55 else _window(shutter, sill=1.2)
        high = _window(shutter, sill=0.9) if rng.random() < 0.65 else door(color)
        parts.append(low.placed((middle, plan.PLINTH, 0)))
        parts.append(high.placed((middle, plan.GALLERY, 0)))
    return [part.placed(back) for part in parts]


def _plaster(side: Side, low: float, high: float, color: ArrayLike) -> Mesh:
    """A stretch of wall in pieces of about 0.8 m, so that its color can vary."""
    start, stop = -plan.DEPTH, side.length + plan.DEPTH
    u = np.linspace(start, stop, round((stop - start) / 0.8) + 1)
    y = np.linspace(low, high, max(1, round((high - low) / 0.8)) + 1)
    rows = [
        strip(_line(u, bottom, 0.0), _line(u, top, 0.0), color)
        for bottom, top in zip(y[:-1].tolist(), y[1:].tolist(), strict=True)
    ]
    return join(rows)


def _line(u: Array, y: float, z: float) -> Array:
    return np.column_stack([u, np.full_like(u, y), np.full_like(u, z)])


def door(color: Array) -> Mesh:
    """A double door of planks under a round arch of stone, standing on y = 0."""
    half, spring = 0.65, 2.05
    edges = np.linspace(-half, half, 9)
    shades = 1 - 0.25 * (np.arange(8) % 2)[:, None]
    planks = strip(_line(edges, 0.02, 0.04), _line(edges, spring, 0.04), color * shades)
    light = fan(
        (0.0, spring, 0.04),
        at_depth(arch(8, (0.0, spring), half), 0.04),
        np.stack([plan.GLASS, color])[np.arange(8) % 2],
    )
    return join([planks, light, _frame(half, spring)])


def _frame(half: float, spring: float) -> Mesh:
    """Jambs and an arch of stone around an opening of the given half width."""
    inner = arch(8, (0.0, spring), half)
    outer = arch(8, (0.0, spring), half + 0.2)
    front = strip(at_depth(inner, 0.12)[::-1], at_depth(outer, 0.12)[::-1], plan.CANTERA)
    soffit = strip(at_depth(inner, 0.12), at_depth(inner, 0.0), plan.CANTERA_DARK)
    rim = strip(at_depth(outer, 0.0), at_depth(outer, 0.12), plan.CANTERA)
    jamb = box((half, 0, 0), (half + 0.2, spring, 0.12), plan.CANTERA, "yz")
    return join([front, soffit, rim, jamb, jamb.placed((-2 * half - 0.2, 0, 0))])


def _window(shutter: Array, sill: float) -> Mesh:
    """A window of six panes with open shutters, its sill at the given height."""
    w, h = 0.5, 1.35
    columns, rows = np.linspace(-w, w, 3), np.linspace(sill, sill + h, 4)
    bars = [
        box((u - 0.025, sill, 0.03), (u + 0.025, sill + h, 0.07), plan.WOOD, "yYz")
        for u in columns.tolist()
    ]
    bars += [
        box((-w, y - 0.025, 0.03), (w, y + 0.025, 0.065), plan.WOOD, "xXz") for y in rows.tolist()
    ]
    pane = quads(
        [(-w, sill, 0.02), (w, sill, 0.02), (w, sill + h, 0.02), (-w, sill + h, 0.02)], plan.GLASS
    )
    leaf = [
        box((w + 0.06, sill + k * h / 4, 0.02), (w + 0.5, sill + (k + 0.85) * h / 4, 0.07), shade)
        for k, shade in enumerate((shutter, shutter * 0.8, shutter, shutter * 0.8))
    ]
    ledge = box((-w - 0.12, sill - 0.1, 0), (w + 0.12, sill, 0.2), plan.CANTERA, "z")
    lintel = box((-w - 0.1, sill + h, 0), (w + 0.1, sill + h + 0.18, 0.12), plan.CANTERA, "z")
    right = join(leaf)
    return join([pane, *bars, right, right.placed((-2 * w - 0.56, 0, 0)), ledge, lintel])


# -- roof over the galleries, with rows of barrel tiles; parapet and bell tower --------------------


_OVERHANG = 0.45  # of the eaves over the court
_SPACING = 0.34  # between ridges of tiles
_ROWS = 3  # of tiles from eaves to parapet
_ROUND = 3  # flat pieces around one tile


def roof(side: Side) -> list[Mesh]:
    """The roof and the parapet of one side."""
    return [_slope(side), _tiles(side), _parapet(side)]


def _height(z: Array | float) -> Array | float:
    """Height of the roof at a local z."""
    return plan.EAVES + (_OVERHANG - z) / (_OVERHANG + plan.DEPTH) * (plan.RIDGE - plan.EAVES)


def _slope(side: Side) -> Mesh:
    """The plane under the tiles, its lower side, and the board along the eaves."""
    u0, u1 = _OVERHANG, side.length - _OVERHANG
    z0, z1 = _OVERHANG, -plan.DEPTH
    y0, y1 = plan.EAVES, plan.RIDGE
    w0, w1 = -plan.DEPTH, side.length + plan.DEPTH
    low = y0 - 0.12
    return quads(
        [
            ((u0, y0, z0), (u1, y0, z0), (w1, y1, z1), (w0, y1, z1)),
            ((u0, low, z0), (u1, low, z0), (u1, y0, z0), (u0, y0, z0)),
            ((0, low, 0), (side.length, low, 0), (u1, low, z0), (u0, low, z0)),
        ],
        [plan.BRICK, plan.DARK_WOOD, plan.DARK_WOOD],
    )


def _tiles(side: Side) -> Mesh:
    """Ridges of half-round tiles up the slope; each tile's lower end lies on the one below."""
    rng = np.random.default_rng((2, side.bays, ord(side.name[0])))
    count = round((side.length + 2 * plan.DEPTH) / _SPACING)
    u = (np.arange(count) + 0.5) / count * (side.length + 2 * plan.DEPTH) - plan.DEPTH
    lowest = np.minimum.reduce([np.full(count, _OVERHANG + 0.08), u, side.length - u])
    edges = np.linspace(_OVERHANG + 0.08, -plan.DEPTH, _ROWS + 1)
    corners, colors, caps = [], [], []
    for near, far in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        start = np.minimum(near, lowest)
        there = start > far
        low = _arc(u[there], start[there], 0.15, lift=0.05)
        high = _arc(u[there], np.full(there.sum(), far), 0.12, lift=0.0)
        corners.append(np.stack([low[:, :-1], high[:, :-1], high[:, 1:], low[:, 1:]], axis=2))
        tint = 0.75 + 0.4 * rng.random((there.sum(), 1))
        warm = plan.TERRACOTTA * tint * (1 + 0.12 * rng.standard_normal((there.sum(), 3)))
        colors.append(np.repeat(np.clip(warm, 0, 1)[:, None], _ROUND, axis=1))
        caps.append(low[:, ::-1])
    tiles = quads(
        np.concatenate([c.reshape(-1, 4, 3) for c in corners]),
        np.concatenate([c.reshape(-1, 3) for c in colors]),
    )
    return join([tiles, quads(caps[0], plan.DARK_WOOD)])


def _arc(u: Array, z: Array, radius: float, lift: float) -> Array:
    """Half circles over points of the slope, from left to right: (n, _ROUND + 1, 3)."""
    a = math.pi - np.arange(_ROUND + 1) * math.pi / _ROUND
    x = u[:, None] + radius * np.cos(a)
    y = np.asarray(_height(z))[:, None] + lift + radius * np.sin(a)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)


def _parapet(side: Side) -> Mesh:
    """The outer wall above the roof, with a coping and a ball at each bay."""
    u0, u1, z = -plan.DEPTH, side.length + plan.DEPTH, -plan.DEPTH
    ball = lathe([(0, 0), (0.14, 0.0), (0.2, 0.14), (0.17, 0.28), (0.0, 0.4)], 6, plan.CANTERA)
    return join(
        [
            box((u0, plan.RIDGE - 0.4, z - 0.3), (u1, plan.PARAPET, z + 0.06), plan.CREAM, "yY"),
            box(
                (u0, plan.PARAPET, z - 0.36),
                (u1, plan.PARAPET + 0.12, z + 0.14),
                plan.CANTERA_DARK,
            ),
            *(
                ball.placed(((bay + 0.5) * side.bay, plan.PARAPET + 0.12, z - 0.1))
                for bay in range(side.bays)
            ),
        ]
    )


def tower() -> Mesh:
    """A bell tower with a tiled dome behind the northeast corner, seen above the roofs."""
    half = 1.7
    face = [
        box((-half, 9.5, half - 0.2), (half, 13.2, half), plan.CREAM, "yYz"),
        box((-half - 0.1, 13.2, half - 0.2), (half + 0.1, 13.5, half + 0.12), plan.CANTERA, "z"),
        box((-half - 0.1, 17.0, half - 0.2), (half + 0.1, 17.35, half + 0.14), plan.CANTERA, "z"),
        box((-half, 13.5, half - 0.2), (-0.8, 17.0, half), plan.CREAM, "yY"),
        box((0.8, 13.5, half - 0.2), (half, 17.0, half), plan.CREAM, "yY"),
        _tower_arch(half),
    ]
    sides = [join(face).placed(yaw=k * math.pi / 2) for k in range(4)]
    bands = np.stack([plan.BLUE, plan.YELLOW])[np.arange(12) % 2]
    dome = lathe(
        [(1.75, 17.3), (1.65, 17.9), (1.35, 18.5), (0.85, 19.0), (0.25, 19.3), (0.12, 19.9)],
        12,
        bands,
    )
    bell = lathe([(0.55, 14.5), (0.4, 15.0), (0.3, 15.5), (0.0, 15.7)], 10, plan.IRON)
    cross = [
        box((-0.04, 19.8, -0.04), (0.04, 20.9, 0.04), plan.IRON),
        box((-0.3, 20.4, -0.04), (0.3, 20.5, 0.04), plan.IRON),
    ]
    return join([*sides, dome, bell, *cross]).placed((27.2, 0, -4.2))


def _tower_arch(half: float) -> Mesh:
    """The round head of an opening of the belfry."""
    curve = at_depth(arch(8, (0.0, 16.0), 0.8), half)[::-1]  # left to right
    head = np.column_stack([curve[:, 0], np.full(len(curve), 17.0), curve[:, 2]])
    return quads(np.stack([curve[:-1], curve[1:], head[1:], head[:-1]], axis=1), plan.CREAM)
