"""Figures of matplotlib that `Result.plot` and `Result.plot_pairs` return.

No window opens, and no global state of matplotlib changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fide_plugins.recording.figures import (
    ACCENT,
    INK,
    MUTED,
    Panel,
    arrangement,
    draw_curve,
    draw_image,
    figure_as_png,
    plain,
)
from fide_plugins.recording.parameters import rows
from fide_plugins.renderers.naming import flat
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import cut
from fide_plugins.space import Choice, Kind, Space
from fide_plugins.types import Float64, Indices, Solution

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as MatplotlibFigure
    from matplotlib.ticker import NullFormatter
except ImportError as error:
    raise missing("plot", "figures need matplotlib") from error


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


_WIDTH, _PICTURES, _LOSS, _PATH = 10.0, 4.5, 2.3, 1.7  # inches
_COLUMNS, _MOST = 4, 12  # parameters in a row, and in all


class Figure(MatplotlibFigure):
    """A figure that a notebook shows, whether or not pyplot is loaded."""

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        return figure_as_png(self)


def result_figure(
    panels: Sequence[Panel],
    losses: Float64,
    loss: str,
    improved_at: Indices,
    path: Float64,
    best: Solution | None,
) -> Figure:
    """Figure of pictures, of losses (n,) by their name, and of the best point so far.

    improved_at: (m,), evaluations from 0; path: (m, dim), the best point since each.
    best: the last of these points; None: no parameters are drawn.
    """
    shown = [] if best is None or not len(path) else drawn(path, best.space, _MOST)
    lines = -(-len(shown) // _COLUMNS)
    n_rows, n_columns, height = arrangement(panels, _WIDTH, _PICTURES)
    heights = [height, _LOSS, *([_PATH * lines] if lines else [])]
    figure = Figure(_WIDTH, sum(heights))
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    pictures = parts[0].subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, panel in zip(pictures, panels, strict=True):
        draw_image(axes, panel)
    draw_curve(parts[1].subplots(), losses, loss)
    if best is not None and lines:
        grid = parts[2].subplots(lines, _COLUMNS, squeeze=False).ravel()
        table = rows([best])
        if len(shown) < len(table):
            words = f"{len(shown)} of {len(table)} parameters, those that moved most"
            parts[2].suptitle(words, fontsize=9, color=MUTED)
        values = {row.name: row.values[0].partition(" ±")[0] for row in table}
        for axes, one in zip(grid, shown, strict=False):
            _draw_path(axes, one, values[one.name], improved_at, len(losses))
        for axes in grid[len(shown) :]:
            axes.axis("off")
    return figure


def curve_figure(losses: Float64, loss: str) -> Figure:
    """Small figure of losses (n,) by their name."""
    figure = Figure(5.0, 1.9)
    draw_curve(figure.subplots(), losses, loss)
    return figure


def _draw_path(axes: Any, one: Drawn, value: str, at: Indices, n: int) -> None:
    """Draw a parameter since each of the evaluations `at`, to the last, n; value: its last one."""
    axes.set_title(one.label, fontsize=9, color=INK, loc="left", pad=4)
    last = plain(cut(value, 22))
    axes.set_title(last, fontsize=8, color=MUTED, loc="right", pad=4)
    one.mark(axes, "y")
    evaluations = [*(at[-len(one.values) :] + 1).tolist(), n]
    axes.step(evaluations, [*one.values, one.values[-1]], where="post", color=ACCENT, linewidth=1.5)
    axes.set_xlim(0, max(2, n))
    axes.grid(axis="y", color="#e4e4e7", linewidth=0.6)
    tidy(axes)


def tidy(axes: Any) -> None:
    """Small axes: small numbers, and two sides only."""
    axes.tick_params(which="both", labelsize=7, colors=MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


_PAIRED = 6  # parameters
_SIDE = 1.8  # inches of one axes
_POINT = "#0e7490"


def pairs_figure(X: Float64, space: Space | None, best: Float64 | None, numbered: bool) -> Figure:
    """Figure of points (n, dim), n >= 1, by every two parameters, and histograms of each.

    best: (dim,), a point to mark.
    numbered: whether the points get their numbers, from 1, and no histograms.

    Of more than six parameters those are drawn in which the points differ most.
    """
    together = X if best is None else np.concatenate([X, best[None]])
    shown = drawn(together, space, _PAIRED)
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
    x, y = across.values, up.values
    if numbered:
        axes.scatter(x, y, s=0)
        for i in range(n):
            axes.text(x[i], y[i], str(i + 1), fontsize=8, ha="center", va="center", color=_POINT)
    else:
        axes.scatter(x[:n], y[:n], s=4, color=_POINT, alpha=0.5, linewidths=0, rasterized=True)
    axes.scatter(x[n:], y[n:], s=70, marker="+", color=ACCENT, linewidths=1.2)
