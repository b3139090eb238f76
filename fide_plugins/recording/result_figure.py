"""The figure of a result: target, best image and their difference, the loss, the parameters.

No window opens, and no global state of matplotlib changes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from textwrap import shorten
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as MatplotlibFigure

from fide_plugins.recording.figures import (
    INK,
    MUTED,
    Panel,
    arrangement,
    draw_curve,
    draw_image,
    plain,
)
from fide_plugins.recording.parameters import rows
from fide_plugins.renderers.naming import flat
from fide_plugins.space import Choice
from fide_plugins.types import Float64, Indices, Solution

__all__ = ["Figure", "curve_figure", "result_figure"]

_WIDTH, _PICTURES, _LOSS, _PATH = 10.0, 4.5, 2.3, 1.7  # inches
_COLUMNS, _MOST = 4, 12  # parameters in a row, and in all
_FEW = 6  # values of a choice that an axis can name
_LINE = "#c2410c"


class Figure(MatplotlibFigure):
    """A figure that a notebook shows, whether or not pyplot is loaded."""

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", metadata={"Software": None})
        return buffer.getvalue()


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
    names = [] if best is None or not len(path) else _moved_most(path, best)
    lines = -(-len(names) // _COLUMNS)
    n_rows, n_columns, height = arrangement(panels, _WIDTH, _PICTURES)
    heights = [height, _LOSS, *([_PATH * lines] if lines else [])]
    figure = Figure(_WIDTH, sum(heights))
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
    pictures = parts[0].subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, panel in zip(pictures, panels, strict=False):
        draw_image(axes, panel)
    for axes in pictures[len(panels) :]:
        axes.axis("off")
    draw_curve(parts[1].subplots(), losses, loss)
    if best is not None and lines:
        grid = parts[2].subplots(lines, _COLUMNS, squeeze=False).ravel()
        _draw_paths(grid, names, best, improved_at, path, len(losses))
    return figure


def curve_figure(losses: Float64, loss: str) -> Figure:
    """Small figure of losses (n,) by their name."""
    figure = Figure(5.0, 1.9)
    draw_curve(figure.subplots(), losses, loss)
    return figure


def _axes_of(best: Solution) -> dict[str, list[int]]:
    """Axes of each parameter, by name."""
    if best.space is None:
        return {f"x[{i}]": [i] for i in range(len(best.x))}
    return best.space.axes


def _moved_most(path: Float64, best: Solution) -> list[str]:
    """Names of the parameters of a path (m, dim), at most `_MOST`: those that moved most."""
    moved = np.ptp(path, axis=0)
    by_name = {name: moved[axes].max(initial=0) for name, axes in _axes_of(best).items()}
    kept = sorted(by_name, key=lambda name: -by_name[name])[:_MOST]
    return [name for name in by_name if name in kept]


def _draw_paths(
    grid: Any, names: list[str], best: Solution, improved_at: Indices, path: Float64, n: int
) -> None:
    """Draw parameters of a path (m, dim) over n evaluations, one in each axes of the grid."""
    space, table = best.space, {row.name: row for row in rows([best])}
    if space is None:
        values = {f"x[{i}]": path[:, i].tolist() for i in range(path.shape[1])}
    else:
        points = [dict(flat(params)) for params in space.decode_many(path)]
        values = {name: [point[name] for point in points] for name in names}
    for axes, name in zip(grid, names, strict=False):
        row = table[name]
        title = shorten(row.label, 26, placeholder="...")
        axes.set_title(plain(title), fontsize=9, color=INK, loc="left", pad=4)
        value = plain(shorten(row.values[0].partition(" ±")[0], 22, placeholder="..."))
        axes.set_title(value, fontsize=8, color=MUTED, loc="right", pad=4)
        kind = None if space is None else space.parameters[name]
        if isinstance(kind, Choice):
            values[name] = _numbered(axes, kind, values[name])
        elif kind is not None and kind.scale.log:
            axes.set_yscale("log")
        _draw_path(axes, values[name], improved_at, n)
    for axes in grid[len(names) :]:
        axes.axis("off")


def _numbered(axes: Any, choice: Choice, values: list[Any]) -> list[int]:
    """Numbers of values of a choice; the axis has the values, if they are many those that occur."""
    numbers = [int(choice.number("", value)) for value in values]
    few = len(choice.values) <= _FEW
    marked = range(len(choice.values)) if few else sorted(set(numbers))
    labels = [shorten(str(choice.values[i]), 12, placeholder="...") for i in marked]
    axes.set_yticks(list(marked), [plain(label) for label in labels])
    return numbers


def _draw_path(axes: Any, values: list[Any], at: Indices, n: int) -> None:
    """Draw the values of one parameter since each of the evaluations `at`, to the last, n."""
    evaluations = [*(at[-len(values) :] + 1).tolist(), n]
    axes.step(evaluations, [*values, values[-1]], where="post", color=_LINE, linewidth=1.5)
    axes.set_xlim(0, max(2, n))
    axes.tick_params(which="both", labelsize=7, colors=MUTED)
    axes.grid(axis="y", color="#e4e4e7", linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
