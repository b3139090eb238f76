"""Trees in raised beds, plants in pots along the arcades, and a flowering climber."""

from __future__ import annotations

import math

import numpy as np

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, box, join, lathe, quads, tube
from fide_tasks.courtyard.plan import Side

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
