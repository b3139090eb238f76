"""Which axes of the cube are one parameter, and which wrap around.

A choice of n > 2 values has n axes, of which the largest coordinate decides: moved singly, they
mostly change nothing, so moves move them together.  A periodic parameter has no walls: 0.99 and
0.01 are near each other.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search import boundary
from fide_plugins.search.mixed import AxisLayout, periodic_axes
from fide_plugins.types import Float64, Indices

__all__ = ["Axes"]


class Axes:
    """Axes of the cube.

    dim: d.  layout: what is discrete or periodic; None: nothing.
    """

    def __init__(self, dim: int, layout: AxisLayout | None = None) -> None:
        self.dim = dim
        self.periodic = periodic_axes(layout)
        first: Indices = np.arange(dim)  # axis of the parameter of each axis
        for block in () if layout is None else layout.choices:
            first[block] = block.start
        self.parameter_of: Indices = np.unique(first, return_inverse=True)[1]
        """(d,), number of the parameter of each axis, from 0."""
        numbers = range(self.parameter_of[-1] + 1)
        self.axes_of = [np.flatnonzero(self.parameter_of == i) for i in numbers]
        """Axes of each parameter."""

    def together(self, chosen: Indices) -> Indices:
        """All axes of the parameters that these axes are of."""
        if len(self.axes_of) == self.dim:
            return chosen
        return np.flatnonzero(np.isin(self.parameter_of, self.parameter_of[chosen]))

    def whole(self, blocks: Indices) -> bool:
        """Whether no parameter has axes in a block (one row each) and outside of it."""
        return all(len(self.together(block)) == len(block) for block in blocks)

    def difference(self, x: Float64, y: Float64, which: Indices | None = None) -> Float64:
        """Differences of coordinates x and y (..., d), the shorter way around; at least 0.

        which: axes (..., m) of coordinates x and y (..., m); None: all.
        """
        if self.periodic is None or which is None:
            return boundary.distance(x, y, self.periodic)
        return boundary.distance(x, y, self.periodic[which])

    def inside(self, x: Float64) -> Float64:
        """Points (..., d) of the cube: periodic axes are wrapped, all others are clipped."""
        return boundary.inside(x, self.periodic)
