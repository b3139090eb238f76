"""Which other values integers and choices can have, and which of them were searched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fide_plugins.runtime.schema import array, check
from fide_plugins.search.mixed import AxisLayout
from fide_plugins.search.scene.axes import Axes
from fide_plugins.types import Float64, Indices

__all__ = ["Values"]

_REMEMBERED = 200  # combinations
_CELLS_AWAY = (*range(2, 9), *(2**i for i in range(4, 10)))
_BEYOND = 1e-9  # beyond an edge, and in the next cell


class Values:
    """Values that integers and choices can have, and which combinations were searched.

    axes: those of one parameter.  layout: what is discrete in the cube.  None: nothing is.
    """

    def __init__(self, axes: Axes | None = None, layout: AxisLayout | None = None) -> None:
        self._axes, self._layout = axes, layout
        self.discrete = np.zeros(1, bool) if layout is None else layout.discrete
        """(d,), axes on which many points stand for one value."""
        self._searched = np.empty((0, int(self.discrete.sum())))  # the oldest first

    def others(self, x: Float64) -> Float64:
        """Copies (n, d) of a rendered point x (d,), each with another value of one parameter.

        All values of a choice; of an integer those up to 8 cells away, and 16, 32, ... 512.
        """
        if self._layout is None or self._axes is None:
            return np.empty((0, len(x)))
        parameters = [axes for axes in self._axes.axes_of if self.discrete[axes[0]]]
        rows = [row for axes in parameters for row in self._changed(x, axes)]
        every = self._layout.snap(np.array(rows).reshape(-1, len(x)))
        every = every[(every != x).any(axis=1)]
        distinct: Float64 = every[np.sort(np.unique(every, axis=0, return_index=True)[1])]
        return distinct

    def _changed(self, x: Float64, axes: Indices) -> Float64:
        """Copies (m, d) of x with coordinates of one parameter changed, x itself among them."""
        if len(axes) > 1:
            rows = np.tile(x, (len(axes), 1))
            rows[:, axes] = np.eye(len(axes))
            return rows
        assert self._layout is not None
        (i,) = axes
        edges = [float(edge[i]) for edge in self._layout.cells(x) if np.isfinite(edge[i])]
        values = [edge + np.copysign(_BEYOND, edge - x[i]) for edge in edges]
        width = 2 * min((abs(edge - x[i]) for edge in edges), default=1.0)
        values += [v for n in _CELLS_AWAY for v in (x[i] - n * width, x[i] + n * width)]
        values = [v for v in values if 0 <= v <= 1]
        rows = np.tile(x, (len(values), 1))
        rows[:, i] = values
        return rows

    def searches(self, X: Float64) -> Indices:
        """How often a search began at the values of each point (n, d), (n,)."""
        same = X[:, None, self.discrete] == self._searched
        return np.asarray(same.all(axis=2).sum(axis=1), np.intp)

    def note(self, x: Float64) -> None:
        """Note that a search begins at the values of x (d,)."""
        every = np.vstack([self._searched, x[self.discrete]])
        self._searched = every[-_REMEMBERED:]

    def forget(self) -> None:
        """Begin again, for another target."""
        self._searched = self._searched[:0]

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"searched": self._searched}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        n = self._searched.shape[1]
        check(dict(state), {"searched": array("m", n, low=0.0, high=1.0)}, {}, "values")
        self._searched = state["searched"]
