"""The fountain, tables, chairs and parasols, and paper flags across the court."""

from __future__ import annotations

import math

import numpy as np

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, box, join, lathe, quads, tube

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
