"""Points of the cube by every two of their parameters, in their units."""

from __future__ import annotations

from typing import Any

import numpy as np

from fide_plugins.recording.figures import ACCENT, INK
from fide_plugins.recording.plots import Drawn, Figure, drawn, tidy
from fide_plugins.space import Space
from fide_plugins.types import Float64

__all__ = ["pairs_figure"]

_MOST = 6  # parameters
_SIDE = 1.8  # inches of one axes
_POINT = "#0e7490"


def pairs_figure(X: Float64, space: Space | None, best: Float64 | None, numbered: bool) -> Figure:
    """Figure of points (n, dim), n >= 1, by every two parameters, and histograms of each.

    best: (dim,), a point to mark.
    numbered: whether the points get their numbers, from 1, and no histograms.

    Of more than six parameters those are drawn in which the points differ most.
    """
    together = X if best is None else np.concatenate([X, best[None]])
    shown = drawn(together, space, _MOST)
    below = 1 if numbered and len(shown) > 1 else 0  # then without a diagonal
    k = len(shown) - below
    figure = Figure(_SIDE * k + 0.6, _SIDE * k + 0.4)
    grid: Any = figure.subplots(k, k, squeeze=False)
    for row, column in np.ndindex(k, k):
        axes, up, across = grid[row, column], shown[row + below], shown[column]
        if column > row:
            axes.axis("off")
            continue
        if up is across:
            _histogram(axes, across, len(X), marked=best is not None)
        else:
            _scatter(axes, across, up, len(X), numbered)
        _label(axes, across, None if up is across else up, numbered)
        axes.tick_params(labelbottom=row == k - 1, labelleft=column == 0)
        if row == k - 1:
            axes.set_xlabel(across.label, fontsize=8, color=INK)
        if column == 0 and up is not across:
            axes.set_ylabel(up.label, fontsize=8, color=INK)
    return figure


def _label(axes: Any, across: Drawn, up: Drawn | None, whole: bool) -> None:
    """Name the axes' values; whole: show all that a parameter may have."""
    from matplotlib.ticker import NullFormatter

    across.mark(axes, "x")
    axes.xaxis.set_minor_formatter(NullFormatter())
    if whole:
        axes.set_xlim(across.limits)
    if up is not None:
        up.mark(axes, "y")
        axes.yaxis.set_minor_formatter(NullFormatter())
        if whole:
            axes.set_ylim(up.limits)
    tidy(axes)


def _histogram(axes: Any, one: Drawn, n: int, marked: bool) -> None:
    """Draw how often values occur; the value of the best point, after the n others, as a line."""
    low, high = one.values.min(), one.values.max()
    log = one.kind is not None and one.kind.scale.log and high > low
    bins: Any = np.geomspace(low, high, 21) if log else 20
    axes.hist(one.values[:n], bins=bins, color=_POINT, alpha=0.6)
    if marked:
        axes.axvline(one.values[n], color=ACCENT, linewidth=1.2)
    axes.set_yticks([])


def _scatter(axes: Any, across: Drawn, up: Drawn, n: int, numbered: bool) -> None:
    """Draw n points, and the best one if there is one more."""
    x, y = across.values, up.values
    if numbered:
        axes.scatter(x, y, s=0)
        for i in range(n):
            axes.text(x[i], y[i], str(i + 1), fontsize=8, ha="center", va="center", color=_POINT)
    else:
        axes.scatter(x[:n], y[:n], s=4, color=_POINT, alpha=0.5, linewidths=0, rasterized=True)
    axes.scatter(x[n:], y[n:], s=70, marker="+", color=ACCENT, linewidths=1.2)
