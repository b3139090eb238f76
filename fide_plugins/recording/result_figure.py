"""The figure of a result: target, best image and their difference, the loss, the parameters.

No window opens, and no global state of matplotlib changes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from fide_plugins.recording.figures import (
    ACCENT,
    INK,
    MUTED,
    Panel,
    arrangement,
    draw_curve,
    draw_image,
    plain,
)
from fide_plugins.recording.parameters import rows
from fide_plugins.recording.plots import Drawn, drawn
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import cut
from fide_plugins.types import Float64, Indices, Solution

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as MatplotlibFigure
except ImportError as error:
    raise missing("plot", "figures need matplotlib") from error

__all__ = ["Figure", "curve_figure", "result_figure", "tidy"]

_WIDTH, _PICTURES, _LOSS, _PATH = 10.0, 4.5, 2.3, 1.7  # inches
_COLUMNS, _MOST = 4, 12  # parameters in a row, and in all


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
