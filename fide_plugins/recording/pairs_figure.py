"""Points of the cube by every two of their parameters, in their units."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins.recording.drawn import Drawn, drawn
from fide_plugins.recording.figures import ACCENT, INK
from fide_plugins.recording.result_figure import Figure, tidy
from fide_plugins.space import Space
from fide_plugins.types import Float64

__all__ = ["pairs_figure"]

_MOST = 6  # parameters
_SIDE = 1.8  # inches of one axes
_POINT = "#0e7490"


def pairs_figure(X: Float64, space: Space | None, best: Float64 | None, numbered: bool) -> Figure:
    """Figure of points (n, dim), n >= 1: histograms, and below them every two parameters.

    best: (dim,), a point to mark.  numbered: whether the points get their numbers, from 1.

    Of more than six parameters those are drawn in which the points differ most.
    """
    together = X if best is None else np.concatenate([X, best[None]])
    shown = drawn(together, space, _MOST)
    k = len(shown)
    figure = Figure(_SIDE * k + 0.6, _SIDE * k + 0.4)
    grid: Any = figure.subplots(k, k, squeeze=False)
    for row, column in np.ndindex(k, k):
        axes = grid[row, column]
        if column > row:
            axes.axis("off")
        elif column == row:
            _histogram(axes, shown[row], len(X), marked=best is not None)
        else:
            _scatter(axes, shown[column], shown[row], len(X), numbered)
        if row == k - 1:
            axes.set_xlabel(shown[column].label, fontsize=8, color=INK)
        if column == 0 and row:
            axes.set_ylabel(shown[row].label, fontsize=8, color=INK)
    return figure


def _histogram(axes: Any, one: Drawn, n: int, marked: bool) -> None:
    """Draw how often values occur; the value of the best point, after the n others, as a line."""
    one.mark(axes, "x")
    low, high = one.values.min(), one.values.max()
    log = axes.get_xscale() == "log" and high > low
    bins: Any = np.geomspace(low, high, 21) if log else 20
    axes.hist(one.values[:n], bins=bins, color=_POINT, alpha=0.6)
    if marked:
        axes.axvline(one.values[n], color=ACCENT, linewidth=1.2)
    axes.set_yticks([])
    tidy(axes)


def _scatter(axes: Any, across: Drawn, up: Drawn, n: int, numbered: bool) -> None:
    """Draw n points, and the best one if there is one more."""
    across.mark(axes, "x")
    up.mark(axes, "y")
    x, y = across.values, up.values
    if numbered:
        axes.scatter(x, y, s=0)
        for i in range(n):
            axes.text(x[i], y[i], str(i + 1), fontsize=8, ha="center", va="center", color=_POINT)
    else:
        axes.scatter(x[:n], y[:n], s=4, color=_POINT, alpha=0.5, linewidths=0, rasterized=True)
    axes.scatter(x[n:], y[n:], s=70, marker="+", color=ACCENT, linewidths=1.2)
    tidy(axes)
