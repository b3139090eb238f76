"""The court: paving, walks and stairs; fountain, furniture and flags; plants."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.building import door
from fide_tasks.courtyard.mesh import Array, Mesh, box, join, lathe, quads, tube
from fide_tasks.courtyard.plan import Side

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


# -- fountain, tables, chairs and parasols, paper flags --------------------------------------------


# x, z of each table, and whether a parasol stands over it
_TABLES = (
    ((12.4, 1.6), True),
    ((9.0, 4.9), False),
    ((12.7, 9.7), True),
    ((16.2, 10.9), False),
    ((19.4, 9.2), False),
    ((22.9, 5.4), True),
    ((19.3, 1.3), False),
)
_CLOTHS = (plan.RED, plan.WHITE, plan.TEAL, plan.YELLOW, plan.MAGENTA, plan.WHITE, plan.BLUE)
_FLAGS = (plan.MAGENTA, plan.YELLOW, plan.TEAL, plan.WHITE, plan.RED, plan.GREEN, plan.BLUE)


def fountain() -> Mesh:
    """An octagonal basin of painted tiles, two bowls on a shaft, and falling water."""
    painted = np.stack([plan.BLUE, plan.WHITE, plan.YELLOW, plan.WHITE])[np.arange(16) % 4]
    stone, dark = plan.CANTERA, plan.CANTERA_DARK
    shaft = [(0.5, 0.0), (0.3, 0.6), (0.2, 1.0), (0.26, 1.3), (0.16, 1.35)]
    bowl = [(0.16, 1.35), (0.7, 1.5), (1.0, 1.75), (1.02, 1.85), (0.9, 1.8), (0.0, 1.78)]
    upper = [(0.12, 1.78), (0.1, 2.3), (0.35, 2.4), (0.5, 2.55), (0.42, 2.52), (0.0, 2.5)]
    tip = [(0.07, 2.5), (0.06, 2.75), (0.14, 2.9), (0.1, 3.05), (0.0, 3.2)]
    return join(
        [
            lathe([(2.3, -0.05), (2.3, 0.12), (2.1, 0.12)], 8, dark, faceted=True),
            lathe([(2.05, 0.1), (2.05, 0.55)], 16, painted, faceted=True),
            lathe([(2.2, 0.55), (2.2, 0.67), (1.8, 0.67), (1.8, 0.4)], 16, stone, faceted=True),
            lathe([(2.05, 0.55), (2.2, 0.55)], 16, stone, faceted=True),
            lathe([(1.8, 0.5), (0.0, 0.5)], 16, plan.WATER),
            lathe(shaft, 12, stone),
            lathe(bowl, 16, np.array([stone, stone, dark, dark, plan.WATER])[:, None]),
            lathe(upper, 12, np.array([stone, dark, stone, dark, plan.WATER])[:, None]),
            lathe(tip, 10, stone),
            *_jets(8, 1.0, 1.82, 1.45, 0.5),
            *_jets(6, 0.48, 2.54, 0.8, 1.8),
        ]
    ).placed((plan.CENTER[0], 0, plan.CENTER[1]))


def _jets(count: int, start: float, top: float, end: float, bottom: float) -> list[Mesh]:
    """Threads of water falling from a rim to the water below."""
    t = np.linspace(0, 1, 5)
    path = np.stack(
        [start + (end - start) * t, top - (top - bottom) * t**2, np.zeros_like(t)], axis=1
    )
    jet = tube(path, np.full(5, 0.025), 4, plan.WHITE)
    return [jet.placed(yaw=2 * math.pi * (k + 0.5) / count) for k in range(count)]


def tables() -> list[Mesh]:
    """Every table with its cloth and four chairs, none of them quite in order."""
    rng = np.random.default_rng(5)
    parts = []
    for ((x, z), shaded), cloth in zip(_TABLES, _CLOTHS, strict=True):
        yaw = rng.uniform(0, math.pi / 2)
        parts.append(_table(cloth, shaded).placed((x, 0, z), yaw))
        for k in range(4):
            around = yaw + k * math.pi / 2 + rng.uniform(-0.25, 0.25)
            away = rng.uniform(0.8, 1.0)
            at = (x + away * math.sin(around), 0.0, z + away * math.cos(around))
            parts.append(_chair().placed(at, around + rng.uniform(-0.3, 0.3)))
    return parts


def _table(cloth: Array, shaded: bool) -> Mesh:
    skirt = [(0.62, 0.5), (0.56, 0.76), (0.0, 0.76)]
    tints = cloth * np.where(np.arange(14) % 2, 1.0, 0.72)[:, None]
    parts = [
        lathe([(0.3, 0.0), (0.3, 0.05), (0.06, 0.08), (0.06, 0.7)], 8, plan.IRON),
        lathe(skirt, 14, tints),
        lathe([(0.07, 0.76), (0.09, 0.9), (0.05, 0.98), (0.0, 0.98)], 8, plan.TEAL),
    ]
    return join([*parts, _parasol(cloth)] if shaded else parts)


def _parasol(cloth: Array) -> Mesh:
    panels = np.where((np.arange(10) % 2)[:, None], cloth, plan.WHITE)
    canopy = [(1.55, 2.25), (1.6, 2.4), (0.0, 3.0)]
    return join(
        [
            lathe([(0.03, 0.7), (0.03, 2.9)], 6, plan.WOOD),
            lathe(canopy, 10, panels, faceted=True),
            lathe([(0.0, 2.9), (1.55, 2.25)], 10, panels * 0.6, faceted=True),
        ]
    )


def _chair() -> Mesh:
    """A wooden chair with a woven seat; its back is toward +z."""
    legs = [
        box((x - 0.02, 0, z - 0.02), (x + 0.02, height, z + 0.02), plan.WOOD, "yY")
        for x in (-0.19, 0.19)
        for z, height in ((-0.19, 0.45), (0.19, 0.98))
    ]
    slats = [
        box((-0.19, y, 0.175), (0.19, y + 0.1, 0.2), plan.WOOD, "xX") for y in (0.58, 0.72, 0.86)
    ]
    seat = box((-0.22, 0.43, -0.22), (0.22, 0.48, 0.21), plan.YELLOW * 0.8)
    return join([*legs, *slats, seat])


def flags() -> list[Mesh]:
    """Strings of paper flags from gallery to gallery."""
    spans = (
        ((plan.WEST, 6.9, 1.1), (plan.EAST, 6.9, 3.6)),
        ((plan.WEST, 6.9, 8.9), (plan.EAST, 6.9, 6.3)),
        ((10.4, 6.9, plan.NORTH), (13.2, 6.9, plan.SOUTH)),
        ((21.6, 6.9, plan.NORTH), (18.8, 6.9, plan.SOUTH)),
    )
    return [_string(np.array(a), np.array(b), 0.9) for a, b in spans]


def _string(start: Array, stop: Array, sag: float) -> Mesh:
    """A cord that hangs from start to stop with a flag every 0.55 m."""
    count = round(float(np.linalg.norm(stop - start)) / 0.55)
    t = np.linspace(0, 1, count + 1)[:, None]
    cord = start + (stop - start) * t - [0.0, sag, 0.0] * (4 * t * (1 - t))
    left, right = cord[:-1] * 0.9 + cord[1:] * 0.1, cord[:-1] * 0.1 + cord[1:] * 0.9
    drop = np.array([0.0, 0.42, 0.0])
    corners = np.stack([left - drop, right - drop, right, left], axis=1)
    colors = np.stack(_FLAGS)[np.arange(count) % len(_FLAGS)]
    return join([quads(corners, colors), tube(cord, np.full(count + 1, 0.008), 3, plan.WHITE)])


# -- trees in raised beds, plants in pots, a flowering climber -------------------------------------


_TREES = ((9.6, 8.9, 1.0), (22.3, 9.0, 0.9), (9.7, 1.2, 0.85))  # x, z, size
_CROWN = 840  # leaves of a tree


def trees() -> list[Mesh]:
    """Each tree of another shape, in an octagonal bed with flowers."""
    rng = np.random.default_rng(6)
    return [_tree(rng).placed((x, 0, z), rng.uniform(0, 6), size) for x, z, size in _TREES]


def _tree(rng: np.random.Generator) -> Mesh:
    bed = [
        lathe([(1.2, 0), (1.2, 0.45), (0.95, 0.45), (0.95, 0.3)], 8, plan.CANTERA, faceted=True),
        lathe([(0.95, 0.36), (0.0, 0.4)], 8, plan.BARK * 0.7),
    ]
    greens = _ball(rng, 40, (0, 0.4, 0), (0.85, 0.18, 0.85), 0.22, plan.LEAF)
    blooms = _ball(rng, 40, (0, 0.42, 0), (0.85, 0.22, 0.85), 0.16, plan.YELLOW)
    bole = np.array([(0.0, 0.3, 0.0), (0.1, 1.6, -0.05), (0.15, 2.9, 0.1)])
    trunk = tube(bole, [0.22, 0.15, 0.12], 7, plan.BARK)
    limbs, crown = [], []
    clusters = 7
    for k in range(clusters):
        angle = 2 * math.pi * k / clusters + rng.uniform(-0.3, 0.3)
        reach, rise = rng.uniform(0.9, 1.7), rng.uniform(0.8, 2.2)
        tip = bole[-1] + np.array([reach * math.cos(angle), rise, reach * math.sin(angle)])
        bend = bole[-1] + (tip - bole[-1]) * [0.4, 0.6, 0.4]
        limbs.append(tube(np.stack([bole[-1], bend, tip]), [0.09, 0.06, 0.03], 5, plan.BARK))
        size = rng.uniform(0.75, 1.1)
        radii = (size, 0.7 * size, size)
        crown.append(_ball(rng, _CROWN // clusters, tip, radii, 0.3, plan.LEAF))
    return join([*bed, greens, blooms, trunk, *limbs, *crown])


def _ball(
    rng: np.random.Generator,
    count: int,
    center: Array | tuple[float, float, float],
    radii: tuple[float, float, float],
    length: float,
    color: Array,
) -> Mesh:
    """A cloud of leaves about an ellipsoid, most of them near its surface."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    depth = rng.uniform(0.45, 1.0, (count, 1)) ** 0.5
    places = np.asarray(center) + direction * depth * radii
    shade = (0.55 + 0.6 * depth) * rng.uniform(0.75, 1.2, (count, 1))
    tint = 1 + rng.uniform(-0.15, 0.25, (count, 1)) * [1.0, 0.3, 0.0]
    return leaves(rng, places, direction, length, np.clip(color * shade * tint, 0, 1))


def leaves(
    rng: np.random.Generator, places: Array, outward: Array, length: float, colors: Array
) -> Mesh:
    """Rhombic leaves at `places`, (n, 3), that face `outward`, (n, 3), more or less."""
    n = len(places)
    facing = outward + 0.7 * rng.standard_normal((n, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, rng.standard_normal((n, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(facing, along)
    size = length * rng.uniform(0.7, 1.2, (n, 1))
    a, b = along * size / 2, across * size * 0.28
    return quads(
        np.stack([places - a, places + b, places + a, places - b], axis=1)[:, ::-1], colors
    )


def pots(side: Side) -> list[Mesh]:
    """A pot before every column of one side, where the stairs leave room for it."""
    rng = np.random.default_rng((7, side.bays, ord(side.name[0])))
    parts = []
    for i in range(1, side.bays):
        u = i * side.bay
        if side.name == "north" and 9.0 < u < 19.5:
            continue
        kind = (_bush, _agave, _flowering)[rng.integers(3)]
        plant = kind(rng).placed(yaw=rng.uniform(0, 6), scale=rng.uniform(0.85, 1.25))
        parts.append(plant.placed((u + rng.uniform(-0.1, 0.1), 0.0, 1.15)))
    return parts


def _pot(color: Array) -> Mesh:
    profile = [(0.2, 0), (0.31, 0.38), (0.35, 0.4), (0.35, 0.48), (0.28, 0.48), (0.0, 0.42)]
    colors = np.array([color, color * 0.9, color, color, plan.BARK * 0.6])[:, None]
    return lathe(profile, 10, colors)


def _bush(rng: np.random.Generator) -> Mesh:
    """A clipped ball on a stem."""
    stem = tube([(0, 0.4, 0), (0.02, 0.8, 0), (0, 1.1, 0)], [0.03, 0.03, 0.03], 5, plan.BARK)
    crown = _ball(rng, 90, (0, 1.25, 0), (0.42, 0.42, 0.42), 0.2, plan.GREEN)
    return join([_pot(plan.TERRACOTTA), stem, crown])


def _agave(rng: np.random.Generator) -> Mesh:
    """A rosette of stiff blades."""
    blades = []
    for k in range(18):
        rise = 0.25 + 0.75 * (k / 18)
        tip = np.array([0.75 * (1.15 - rise), 0.45 + 0.75 * rise, 0.0])
        w = 0.07
        base, knee = np.array([0.03, 0.44, 0.0]), np.array([tip[0] * 0.6, 0.35 + tip[1] * 0.45, 0])
        side = np.array([0.0, 0.0, w])
        lower = np.stack([base + side * 0.5, knee + side, knee - side, base - side * 0.5])
        upper = np.stack([knee + side, tip + side * 0.05, tip - side * 0.05, knee - side])
        shade = plan.LEAF * [0.8, 1.0, 1.3] * rng.uniform(0.7, 1.1)
        blades.append(quads(np.stack([lower, upper]), shade).placed(yaw=2.4 * k))
    return join([_pot(plan.BLUE), *blades])


def _flowering(rng: np.random.Generator) -> Mesh:
    """Geraniums: a low cushion of green with red and pink flowers."""
    cushion = _ball(rng, 60, (0, 0.6, 0), (0.38, 0.25, 0.38), 0.2, plan.LEAF)
    tone = (plan.RED, plan.MAGENTA, plan.WHITE)[rng.integers(3)]
    bloom = _ball(rng, 40, (0, 0.68, 0), (0.4, 0.27, 0.4), 0.14, tone * 1.3)
    return join([_pot(plan.TERRACOTTA), cushion, bloom])


def climber() -> Mesh:
    """Bougainvillea over a corner of the south side and down two of its columns."""
    rng = np.random.default_rng(8)
    south = plan.SIDES[1]
    width = 3.2 * south.bay
    u = rng.uniform(-0.2, width, 520)
    hang = 0.5 + 0.5 * np.cos(u / width * math.pi)
    y = 4.75 + rng.uniform(-0.55, 0.75, len(u)) * (0.4 + hang)
    z = 0.32 + 0.25 * rng.random(len(u)) * (0.5 + hang)
    bough = _foliage(rng, np.stack([u, y, z], axis=1), (0.2, 0.3, 1.0))
    stems = []
    for column, count in ((1, 110), (2, 80)):
        angle = rng.uniform(0, 2 * math.pi, count)
        out = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
        height = rng.uniform(0.5, 4.3, count)[:, None] * [0.0, 1.0, 0.0]
        at = out * (0.2 + 0.12 * rng.random((count, 1))) + height + [column * south.bay, 0, 0]
        stems.append(_foliage(rng, at, out))
    beds = [
        box((k * south.bay - 0.35, 0, 0.4), (k * south.bay + 0.35, 0.5, 0.8), plan.BRICK, "y")
        for k in (1, 2)
    ]
    return join([bough, *stems, *beds]).placed(*south.frame)


def _foliage(rng: np.random.Generator, places: Array, outward: Array | tuple[float, ...]) -> Mesh:
    """Leaves, two thirds of them in flower."""
    n = len(places)
    bloom = (rng.random(n) < 0.65)[:, None]
    colors = np.where(bloom, plan.MAGENTA, plan.GREEN) * rng.uniform(0.7, 1.3, (n, 1))
    facing = np.broadcast_to(np.asarray(outward, np.float64), (n, 3))
    return leaves(rng, places, facing, 0.24, np.clip(colors, 0, 1))
