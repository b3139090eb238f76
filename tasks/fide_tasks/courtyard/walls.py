"""The walls behind the arcades: mottled plaster, painted feet, doors and windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fide_tasks.courtyard import plan
from fide_tasks.courtyard.mesh import Array, Mesh, arch, at_depth, box, fan, join, quads, strip
from fide_tasks.courtyard.plan import Side

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
