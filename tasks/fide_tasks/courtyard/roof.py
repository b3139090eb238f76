"""The roof over the galleries, with its rows of barrel tiles, the parapet and a bell tower."""

from __future__ import annotations

import math

import numpy as np

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, arch, at_depth, box, join, lathe, quads
from fide_tasks.courtyard.plan import Side

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
