"""Points at which one parameter has its low, middle and high value, and others are as they were."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fide_plugins.renderers.naming import flat
from fide_plugins.space import Float, Kind, Space
from fide_plugins.types import Float64

__all__ = ["Sweep", "middle_of", "other_values", "sweeps"]

MOST = 5
"""Values of an integer or a choice, at most."""
_ENDS_AND_MIDDLE = np.array([[0.0], [0.5], [1.0]])
_ELSEWHERE = (0.37, 0.71)  # of an axis, around which it is closed: no value twice, no symmetry


@dataclass(frozen=True)
class Sweep:
    """One parameter and its values.

    name, unit: of the parameter.  axes: of the cube.  range: in words.
    X: (k, dim), a point for each value.  texts: of the values.
    kind: None without a space.
    """

    name: str
    unit: str | None
    axes: list[int]
    range: str
    X: Float64 = field(repr=False)
    texts: list[str]
    kind: Kind | None


def sweeps(space: Space | int, center: Float64) -> list[Sweep]:
    """A sweep around the point (dim,) of each parameter that can vary, in order."""
    if isinstance(space, int):
        return [_of_axis(i, center) for i in range(space)]
    layout, found = space.layout, []
    for i, (name, kind) in enumerate(space.parameters.items()):
        axes = space.axes[name]
        if not axes:
            continue
        numbers = _numbers(kind)
        placed = _ENDS_AND_MIDDLE
        if numbers:
            V = np.repeat(layout.numbers(center[None]), len(numbers), axis=0)
            V[:, i] = numbers
            placed = layout.points(V)[:, axes]
        X = np.repeat(center[None], len(placed), axis=0)
        X[:, axes] = placed
        values = [dict(flat(params))[name] for params in space.decode_many(X)]
        texts = [text_of(value) for value in values]
        found.append(Sweep(name, kind.unit, axes, _range(kind), X, texts, kind))
    return found


def middle_of(space: Space | int, rng: np.random.Generator) -> Float64:
    """The middle of the box (dim,); repeated groups have random values, so that they differ."""
    middle = np.full(space if isinstance(space, int) else space.dim, 0.5)
    repeated = [] if isinstance(space, int) else [axis for block in space.groups for axis in block]
    middle[repeated] = rng.uniform(0.2, 0.8, len(repeated))
    return middle


def other_values(sweep: Sweep, base: Float64) -> Float64:
    """Points (n, dim) where all but this parameter are as at the point (dim,), and it is not."""
    if len(sweep.axes) > 1 or (sweep.kind is not None and sweep.kind.scale.step):
        X = np.repeat(base[None], len(sweep.X), axis=0)
        X[:, sweep.axes] = sweep.X[:, sweep.axes]
        return X
    X = np.repeat(base[None], len(_ELSEWHERE), axis=0)
    X[:, sweep.axes[0]] = (base[sweep.axes[0]] + np.array(_ELSEWHERE)) % 1.0
    return X


def text_of(value: Any) -> str:
    """A value in four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _of_axis(i: int, center: Float64) -> Sweep:
    X = np.repeat(center[None], 3, axis=0)
    X[:, i] = (0.0, 0.5, 1.0)
    return Sweep(f"x[{i}]", None, [i], "0 to 1", X, ["0", "0.5", "1"], None)


def _numbers(kind: Kind) -> list[float]:
    """Numbers of its values, at most five of them; none if it is continuous."""
    low, high, step, log = kind.scale
    if not step:
        return []
    count = round((high - low) / step)
    if log and count >= MOST:
        steps = np.geomspace(low, high, MOST) - low
    else:
        steps = np.linspace(0, count, min(count + 1, MOST)) * step
    return list(dict.fromkeys(float(low + round(one / step) * step) for one in steps))


def _range(kind: Kind) -> str:
    low, high, step, log = kind.scale
    if not isinstance(kind, Float) and not hasattr(kind, "low"):
        return f"{round(high) + 1} values"
    notes = ["log"] * log + ["periodic"] * (getattr(kind, "periodic", False) is True)
    if step and step != 1:
        notes.append(f"step {step:g}")
    return f"{low:g} to {high:g}" + (f" ({', '.join(notes)})" if notes else "")
