"""Parameters of several points as numbers on axes of a figure, in their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fide_plugins.recording.figures import plain
from fide_plugins.renderers.naming import flat
from fide_plugins.runtime.messages import cut
from fide_plugins.space import Choice, Kind, Space
from fide_plugins.types import Float64

__all__ = ["Drawn", "drawn"]

_FEW = 6  # values of a choice that an axis can name


@dataclass(frozen=True, eq=False)
class Drawn:
    """A parameter.

    values: (n,), of a choice the index of each value.  kind: None for a coordinate of the cube.
    """

    name: str
    values: Float64
    kind: Kind | None = None

    @property
    def label(self) -> str:
        """Name and unit, escaped for matplotlib, cut where it is long."""
        unit = "" if self.kind is None or self.kind.unit is None else f" [{self.kind.unit}]"
        return plain(cut(self.name, 24) + unit)

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of an axis with every value that it may have."""
        low, high, step, log = (0.0, 1.0, 0.0, False) if self.kind is None else self.kind.scale
        return (low, high) if log else (low - step / 2, high + step / 2)

    def mark(self, axes: Any, axis: Literal["x", "y"]) -> None:
        """Make an axis logarithmic where the parameter is, or name the values of a choice on it."""
        if isinstance(self.kind, Choice):
            values = self.kind.values
            every = range(len(values)) if len(values) <= _FEW else set(self.values.astype(int))
            names = [plain(cut(str(values[i]), 12)) for i in sorted(every)]
            getattr(axes, f"set_{axis}ticks")(sorted(every), names)
        elif self.kind is not None and self.kind.scale.log:
            getattr(axes, f"set_{axis}scale")("log")


def drawn(X: Float64, space: Space | None, most: int) -> list[Drawn]:
    """Parameters of points (n, dim) of the cube, at most so many: those in which they differ most.

    They come in the order of the space.
    """
    spread = np.ptp(X, axis=0)
    if space is None:
        kept = np.sort(np.argsort(-spread, kind="stable")[:most])
        return [Drawn(f"x[{i}]", X[:, i]) for i in kept.tolist()]
    wide = {name: -spread[axes].max(initial=0) for name, axes in space.axes.items()}
    names = sorted(wide, key=wide.__getitem__)[:most]
    points = [dict(flat(params)) for params in space.decode_many(X)]
    return [
        Drawn(name, np.array([kind.number(name, point[name]) for point in points]), kind)
        for name, kind in space.parameters.items()
        if name in names
    ]
