"""The charts of a report, as matplotlib figures; no window, no global state.

The same figure serves a paper (PNG, SVG) and the page, where a style sheet sets the colors: see
`fide_lab.report.svg`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_lab.report import statistics
from fide_lab.report.labels import fitted
from fide_lab.report.panel import Panel, Row
from fide_lab.report.tables import number
from fide_plugins.recording.figures import plain
from fide_plugins.recording.record import PARTS
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "AXIS_NAMES",
    "INK",
    "MUTED",
    "PART_COLORS",
    "Style",
    "convergence",
    "profile",
    "style",
    "times",
    "tradeoff",
]

INK, MUTED, RULE = "#1a1a1b", "#6b7078", "#e2e4e8"
PALETTE = (
    "#c2410c", "#1d4ed8", "#15803d", "#7e22ce", "#0e7490", "#a16207", "#be185d", "#475569",
)  # fmt: skip
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.2, 1.6)), (0, (5, 1.5, 1.2, 1.5)))
MARKERS = ("o", "s", "^", "D")
PART_COLORS = {
    "render": "#64748c", "encode": "#0e7491", "train": "#c2410d", "search": "#a16208",
    "other": "#9ca3b0",
}  # fmt: skip
"""Each differs slightly from the palette, so that `svg` can tell all colors apart."""

_MANY = 4  # with more series, the legend stands beside the plot
_LONGEST = 28  # most characters of a name in a figure

AXIS_NAMES = {
    "renders": "renders",
    "seconds": "seconds",
    "rounds": "rounds of 8 parallel renders",
}


@dataclass(frozen=True)
class Style:
    """Line style of a configuration; dash: for matplotlib; dashes: for a legend in SVG."""

    color: str
    dash: Any
    dashes: str


def style(index: int) -> Style:
    """Style of the configuration at position `index`: eight colors, then again with dashes."""
    dash = DASHES[index // len(PALETTE) % len(DASHES)]
    dashes = "" if dash == "solid" else " ".join(str(1.5 * length) for length in dash[1])
    return Style(PALETTE[index % len(PALETTE)], dash, dashes)


def convergence(panel: Panel, axis: str, legend: bool = True) -> Figure:
    """Median and bands of the best loss so far of every configuration along one axis.

    legend: for a paper; the page has its own.  It stands beside the plot if there are many series.
    """
    beside = legend and len(panel.rows) > _MANY
    room = 0.5 + 0.062 * max(len(_label(row)) for row in panel.rows) if beside else 0.1
    figure, axes = _canvas(5.1 + room, 3.6, left=0.62, top=0.26, right=room)
    drawn = []
    for row in panel.rows:
        curves = [run.curve for run in row.runs if run.curve]
        found = statistics.bands(curves, axis, len(row.failed))
        if len(found.x) and np.isfinite(found.values).any():
            drawn.append((row, found))
    if drawn:
        _scale(axes, "x", np.concatenate([found.x for _, found in drawn]))
        _scale(axes, "y", np.concatenate([found.values.ravel() for _, found in drawn]))
    for row, found in drawn:
        _series(axes, row, found)
    axes.set_xlabel(AXIS_NAMES[axis], fontsize=10, color=INK)
    _title(axes, panel.loss)
    if drawn and beside:
        _legend(axes, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    elif drawn and legend:
        _legend(axes, loc="lower left")
    if not drawn:
        axes.text(0.5, 0.5, "no optimizer has a finite median", color=MUTED, ha="center",
                  transform=axes.transAxes)  # fmt: skip
    return figure


def times(panel: Panel, legend: bool = True) -> Figure:
    """Time of one evaluation by part: one bar for each configuration, and its total.

    The bars show fractions, since one optimizer may take a thousand times as long as another.
    """
    rows = panel.rows
    room = 0.2 + 0.075 * max(len(_label(row)) for row in rows)
    top = 0.24 if legend else 0.05
    figure, axes = _canvas(5.2, 0.66 + top + 0.26 * len(rows), room, top=top, right=0.85)
    left = np.zeros(len(rows))
    split = [row.milliseconds() for row in rows]
    totals = [sum(parts.values()) for parts in split]
    for part in (*PARTS, "other"):
        width = np.array(
            [100.0 * parts[part] / max(total, 1e-9)
             for parts, total in zip(split, totals, strict=True)]
        )  # fmt: skip
        axes.barh(range(len(rows)), width, left=left, height=0.62, color=PART_COLORS[part],
                  label=part)  # fmt: skip
        left += width
    for line, total in enumerate(totals):
        axes.text(102, line, f"{total:.3g} ms", fontsize=9, color=INK, va="center")
    axes.set_yticks(range(len(rows)), [plain(_label(row)) for row in rows], fontsize=9, color=INK)
    axes.set_xlim(0, 100)
    axes.invert_yaxis()
    axes.set_xlabel("percentage of the time of an evaluation", fontsize=10, color=INK)
    axes.grid(axis="y", visible=False)
    if legend:
        above = {"bbox_to_anchor": (0.0, 1.0), "bbox_transform": figure.transFigure}
        _legend(axes, loc="upper left", **above, ncols=5, columnspacing=1.2)
    return figure


def tradeoff(
    curves: dict[str, list[tuple[float, float]]],
    front: list[tuple[float, float]],
    axis: str,
    loss: str,
) -> Figure:
    """Loss against cost of every combination of options, and their Pareto front.

    curves: (cost, loss) by label; the last pair is the end of the runs.
    """
    beside = len(curves) > _MANY
    room = 0.5 + 0.062 * max(map(len, curves)) if beside else 0.1
    figure, axes = _canvas(5.1 + room, 3.6, left=0.72, top=0.26, right=room)
    if front:
        x, y = zip(*front, strict=True)
        axes.step(x, y, where="post", color=INK, linewidth=5, alpha=0.15, label="front")
    for index, (label, points) in enumerate(curves.items()):
        x, y = zip(*points, strict=True) if points else ((), ())
        look = style(index)
        axes.plot(x, y, color=look.color, linestyle=look.dash, linewidth=1.2, label=plain(label),
                  marker=MARKERS[index // len(PALETTE) % len(MARKERS)], markersize=4,
                  markevery=[len(x) - 1] if x else None)  # fmt: skip
    every = np.array([point for points in curves.values() for point in points]).reshape(-1, 2)
    _scale(axes, "x", every[:, 0])
    _scale(axes, "y", every[:, 1])
    axes.set_xlabel(AXIS_NAMES[axis], fontsize=10, color=INK)
    _title(axes, loss)
    if beside:
        _legend(axes, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    else:
        _legend(axes, loc="lower left")
    return figure


def profile(
    x: Float64,
    shares: Float64,
    names: Sequence[str],
    axis: str,
    legend: bool = True,
    marks: Sequence[float] = (),
) -> Figure:
    """Shares of problems, in percent, as step functions along a logarithmic axis.

    x: (m,), increasing, positive.  shares: (m, S) in [0, 1], S curves called `names`.
    marks: vertical lines.
    """
    labels = [plain(fitted(name, _LONGEST)) for name in names]
    room = 0.5 + 0.062 * max(map(len, labels)) if legend else 0.1
    figure, axes = _canvas(5.1 + room, 3.6, left=0.62, top=0.26, right=room)
    for mark in marks:
        axes.axvline(mark, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)))
    for index, label in enumerate(labels):
        look = style(index)
        axes.step(x, 100 * shares[:, index], where="post", color=look.color, linestyle=look.dash,
                  linewidth=1.8, label=label)  # fmt: skip
    _scale(axes, "x", x)
    axes.set_ylim(-2, 102)
    axes.set_xlabel(axis, fontsize=10, color=INK)
    axes.set_title("problems solved, %", fontsize=10, color=INK, loc="left", pad=5)
    if legend:
        _legend(axes, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    return figure


def describe(panel: Panel) -> str:
    """Text alternative of a convergence plot."""
    ends = ", ".join(f"{row.name} {number(row.median)}" for row in _from_best(panel.rows))
    return f"Best {panel.loss} so far on {panel.task}; medians at the end: {ends}."


def describe_times(panel: Panel) -> str:
    """Text alternative of a plot of times."""
    totals = ", ".join(f"{row.name} {sum(row.milliseconds().values()):.3g}" for row in panel.rows)
    return f"Milliseconds per evaluation on {panel.task} with {panel.loss}, in total: {totals}."


def _series(axes: Any, row: Row, found: statistics.Bands) -> None:
    """Line and two bands of one configuration, each with an id by which the page can hide it.

    A band that reaches infinity reaches the top; the line has a gap where it is infinite.
    """
    look, median = style(row.index), found.values[2]
    q = np.minimum(found.values, axes.get_ylim()[1])
    wide, mid = {"alpha": 0.10, "linewidth": 0}, {"alpha": 0.20, "linewidth": 0}
    axes.fill_between(found.x, q[0], q[4], color=look.color, **wide).set_gid(f"s{row.index} wide")
    axes.fill_between(found.x, q[1], q[3], color=look.color, **mid).set_gid(f"s{row.index} mid")
    (line,) = axes.plot(found.x, median, color=look.color, linestyle=look.dash, linewidth=1.8,
                        label=plain(_label(row)))  # fmt: skip
    line.set_gid(f"s{row.index} line")


def _label(row: Row) -> str:
    """Name of a configuration in a figure."""
    return fitted(row.name, _LONGEST)


def _title(axes: Any, loss: str) -> None:
    """Name of the vertical axis, placed above it, where long numbers cannot displace it."""
    axes.set_title(f"best {plain(loss)} so far", fontsize=10, color=INK, loc="left", pad=5)


def _canvas(
    width: float, height: float, left: float, top: float = 0.08, right: float = 0.1
) -> tuple[Figure, Any]:
    """Figure and axes; all in inches; left, top, right: margins of the axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="none")
    FigureCanvasAgg(figure)
    bottom = 0.48
    axes = figure.add_axes(
        (left / width, bottom / height,
         (width - left - right) / width, (height - bottom - top) / height)
    )  # fmt: skip
    axes.set_facecolor("none")
    axes.tick_params(which="both", labelsize=9, colors=MUTED)
    axes.grid(color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(MUTED)
    return figure, axes


def _legend(axes: Any, **where: Any) -> None:
    """Legend for a paper; the page has its own and hides this one."""
    legend = axes.legend(**where, fontsize=7, frameon=False, labelcolor=INK, handlelength=2.8)
    legend.set_gid("legend")


def _scale(axes: Any, which: str, values: Float64) -> None:
    """Logarithmic axis around the positive values, if there are any; zero lies below the plot.

    Labels are decimal (0.01, not a power of ten); a short range has more of them.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    positive = values[(values > 0) & np.isfinite(values)]
    if not len(positive):
        return
    low, high = max(positive.min(), 1e-9 * positive.max()), positive.max()
    room = (high / low) ** 0.04 * 1.02
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low / room, high * room)})
    axis = getattr(axes, f"{which}axis")
    axis.set_major_locator(LogLocator(subs=(1.0,) if high > 50 * low else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _from_best(rows: Sequence[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: row.median)
