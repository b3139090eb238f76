"""The paving of the court, the tiles of the walks, the steps between them, and the stairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, box, join, quads
from fide_tasks.courtyard.plan import Side
from fide_tasks.courtyard.walls import door

_STONE = 0.7  # side of a paving stone
_JOINT = 0.025
_STEPS = 26  # of the stairs
_FOOT, _HEAD = 9.9, 17.05  # where the stairs begin and end along the north side
_STAIRS = (0.5, 1.95)  # their inner and outer side, from the edge of the court


def paving() -> list[Mesh]:
    """Stones of varied color, each a little higher or lower than the next, over dark joints."""
    rng = np.random.default_rng(3)
    nx, nz = round((plan.EAST - plan.WEST) / _STONE), round((plan.SOUTH - plan.NORTH) / _STONE)
    x = np.linspace(plan.WEST, plan.EAST, nx + 1)
    z = np.linspace(plan.NORTH, plan.SOUTH, nz + 1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nx), np.arange(nz), indexing="ij"))
    middle = np.stack([(x[i] + x[i + 1]) / 2, (z[j] + z[j + 1]) / 2], axis=1) - plan.CENTER
    colors = _pattern((i + j) % 2 == 0, middle) * (0.8 + 0.35 * rng.random((len(i), 1)))
    sink = -0.02 * rng.random(len(i))
    stones = _flat(x[i] + _JOINT, x[i + 1] - _JOINT, z[j] + _JOINT, z[j + 1] - _JOINT, sink, colors)
    joints = quads(
        [
            (plan.WEST, -0.05, plan.SOUTH),
            (plan.EAST, -0.05, plan.SOUTH),
            (plan.EAST, -0.05, plan.NORTH),
            (plan.WEST, -0.05, plan.NORTH),
        ],
        plan.GROUT,
    )
    return [joints, stones]


def _pattern(even: NDArray[np.bool_], middle: Array) -> Array:
    """Color of each stone: rings about the fountain, a cross of paths, a checkered field."""
    far = np.abs(middle).max(axis=1)
    ring = (far < 4.2) & (np.floor(far / 0.7) % 2 == 0)
    path = np.abs(middle).min(axis=1) < 0.75
    color = np.where(even[:, None], plan.SLATE, plan.CANTERA_DARK)
    color = np.where(path[:, None], plan.CANTERA, color)
    return np.where(ring[:, None], plan.TERRACOTTA, color)


def _flat(x0: Array, x1: Array, z0: Array, z1: Array, y: Array, colors: Array) -> Mesh:
    """Level rectangles seen from above, given by their limits, each (q,)."""
    corners = np.stack(
        [np.stack(c, axis=1) for c in ((x0, y, z1), (x1, y, z1), (x1, y, z0), (x0, y, z0))], axis=1
    )
    return quads(corners, colors)


def walk(side: Side) -> list[Mesh]:
    """The tiled floor of the arcade and the two steps down to the paving."""
    rng = np.random.default_rng((4, side.bays, ord(side.name[0])))
    start, stop = -side.reach, side.length + side.reach
    nu, nz = round((stop - start) / 0.8), 4
    u, z = np.linspace(start, stop, nu + 1), np.linspace(-plan.DEPTH, 0.0, nz + 1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(nu), np.arange(nz), indexing="ij"))
    dark = ((i + j) % 2 == 0)[:, None]
    colors = np.where(dark, plan.BRICK, plan.CREAM) * (0.85 + 0.2 * rng.random((len(i), 1)))
    level = np.full(len(i), plan.PLINTH)
    tiles = _flat(u[i], u[i + 1], z[j], z[j + 1], level, colors)
    return [tiles, _step(side, 0.36, plan.PLINTH), _step(side, 0.72, plan.PLINTH / 2)]


def _step(side: Side, depth: float, height: float) -> Mesh:
    """A step along one side; two of the four sides also fill its corners."""
    start = 0.0 if side.corners else depth
    color = plan.CANTERA if depth < 0.5 else plan.CANTERA_DARK
    return box((start, 0, 0), (side.length - start, height, depth), color, "xXyz")


def stairs() -> Mesh:
    """A flight from the court up to the gallery, along the north side, on its own wall."""
    inner, outer = _STAIRS
    rise, tread = plan.GALLERY / _STEPS, (_HEAD - _FOOT) / _STEPS
    parts = []
    for k in range(_STEPS):
        u, y = _FOOT + k * tread, (k + 1) * rise
        stone = plan.CANTERA if k % 2 else plan.CANTERA * 0.88
        parts.append(box((u, y - rise, inner), (u + tread, y, outer - 0.18), stone, "XyZz"))
    top = plan.GALLERY
    landing = box((_HEAD, 4.35, 0.2), (_HEAD + 2.2, top, outer), plan.CANTERA)
    post = box((_HEAD + 1.9, 0, outer - 0.35), (_HEAD + 2.2, 4.35, outer), plan.CREAM, "yY")
    rail = box((_HEAD, top, outer - 0.18), (_HEAD + 2.2, top + 0.9, outer), plan.CREAM, "y")
    end = box((_HEAD + 2.02, top, 0.36), (_HEAD + 2.2, top + 0.9, outer - 0.18), plan.CREAM, "y")
    closet = door(plan.TEAL).placed((_HEAD - 1.3, 0, outer))
    walls = [_cheek(outer), _cheek_back(inner), closet]
    return join([*parts, *walls, landing, post, rail, end]).placed(plan.SIDES[0].frame.at)


def _cheek(outer: float) -> Mesh:
    """The outer wall of the flight with its sloping parapet and coping."""
    low, high = _FOOT - 0.2, _HEAD
    y0, y1 = 0.9, plan.GALLERY + 0.9
    z0, z1 = outer - 0.18, outer
    faces = [
        ((low, 0, z1), (high, 0, z1), (high, y1, z1), (low, y0, z1)),
        ((high, 0, z0), (low, 0, z0), (low, y0, z0), (high, y1, z0)),
        ((low, 0, z0), (low, 0, z1), (low, y0, z1), (low, y0, z0)),
        ((high, 0, z1), (high, 0, z0), (high, y1, z0), (high, y1, z1)),
    ]
    foot = z1 + 0.012  # a painted foot like that of the walls
    paint = [((low, 0, foot), (high, 0, foot), (high, 1.0, foot), (low + 0.1, 1.0, foot))]
    a, b = outer - 0.23, outer + 0.05
    cap = [
        ((low, y0 + 0.1, b), (high, y1 + 0.1, b), (high, y1 + 0.1, a), (low, y0 + 0.1, a)),
        ((low, y0, b), (high, y1, b), (high, y1 + 0.1, b), (low, y0 + 0.1, b)),
        ((high, y1, a), (low, y0, a), (low, y0 + 0.1, a), (high, y1 + 0.1, a)),
    ]
    return join([quads(faces, plan.CREAM), quads(paint, plan.DADO), quads(cap, plan.CANTERA)])


def _cheek_back(inner: float) -> Mesh:
    """The wall under the flight that faces the arcade, and the one under its head."""
    faces = [
        ((_HEAD, 0, inner), (_FOOT, 0, inner), (_FOOT, 0.1, inner), (_HEAD, plan.GALLERY, inner)),
        (
            (_HEAD, 0, _STAIRS[1] - 0.18),
            (_HEAD, 0, inner),
            (_HEAD, plan.GALLERY, inner),
            (_HEAD, plan.GALLERY, _STAIRS[1] - 0.18),
        ),
    ]
    return quads(faces, plan.CREAM)
