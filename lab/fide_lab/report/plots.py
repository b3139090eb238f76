"""Charts and pictures of a report, as matplotlib figures; no window, no global state."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_lab.compare.results import StoredRun
from fide_lab.figures import new_figure, plain
from fide_lab.report import statistics
from fide_lab.report.panel import Panel, Row, fitted
from fide_plugins.types import Float64
from fide_plugins.validation.images import load

if TYPE_CHECKING:
    from matplotlib.figure import Figure


INK, MUTED, RULE = "#1a1a1b", "#6b7078", "#e2e4e8"
PALETTE = (
    "#c2410c", "#1d4ed8", "#15803d", "#7e22ce", "#0e7490", "#a16207", "#be185d", "#475569",
)  # fmt: skip
Pair = tuple[float, float]
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.2, 1.6)), (0, (5, 1.5, 1.2, 1.5)))
_LONGEST = 28  # most characters of a name in a figure
_TITLE = 21  # most characters above a picture of the figure


def style(index: int) -> dict[str, Any]:
    """Line of the configuration at position `index`: eight colors, then again with dashes."""
    dash = DASHES[index // len(PALETTE) % len(DASHES)]
    return {"color": PALETTE[index % len(PALETTE)], "linestyle": dash}


def convergence(panel: Panel, axis: str) -> Figure:
    """Median and bands of the best loss so far of every configuration along one axis."""
    figure, axes = _canvas()
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
        # A band that reaches infinity reaches the top; the line has a gap where it is infinite.
        look, q = style(row.index), np.minimum(found.values, axes.get_ylim()[1])
        for low, high, alpha in ((0, 4, 0.10), (1, 3, 0.20)):
            axes.fill_between(
                found.x, q[low], q[high], color=look["color"], alpha=alpha, linewidth=0
            )
        axes.plot(found.x, found.values[2], **look, linewidth=1.8, label=_label(row.name))
    _titles(axes, axis, f"best {plain(panel.loss)} so far")
    if not drawn:
        axes.text(0.5, 0.5, "no optimizer has a finite median", color=MUTED, ha="center",
                  transform=axes.transAxes)  # fmt: skip
    return figure


def tradeoff(curves: dict[str, list[Pair]], front: list[Pair], axis: str, loss: str) -> Figure:
    """Loss against cost of every combination of options, and their Pareto front.

    curves: (cost, loss) by label; the last pair is the end of the runs.
    """
    figure, axes = _canvas()
    if front:
        x, y = zip(*front, strict=True)
        axes.step(x, y, where="post", color=INK, linewidth=5, alpha=0.15, label="front")
    for index, (label, points) in enumerate(curves.items()):
        x, y = zip(*points, strict=True) if points else ((), ())
        axes.plot(x, y, **style(index), linewidth=1.2, label=_label(label), marker="o",
                  markersize=4, markevery=[len(x) - 1] if x else None)  # fmt: skip
    every = np.array([point for points in curves.values() for point in points]).reshape(-1, 2)
    _scale(axes, "x", every[:, 0])
    _scale(axes, "y", every[:, 1])
    _titles(axes, axis, f"best {plain(loss)} so far")
    return figure


def profile(
    x: Float64, shares: Float64, names: Sequence[str], axis: str, marks: Sequence[float] = ()
) -> Figure:
    """Shares of problems, in percent, as step functions along a logarithmic axis.

    x: (m,), increasing, positive.  shares: (m, S) in [0, 1], S curves called `names`.
    marks: vertical lines.
    """
    figure, axes = _canvas()
    for mark in marks:
        axes.axvline(mark, color=MUTED, linewidth=0.8, linestyle=(0, (1, 2)))
    for index, name in enumerate(names):
        axes.step(x, 100 * shares[:, index], where="post", **style(index), linewidth=1.8,
                  label=_label(name))  # fmt: skip
    _scale(axes, "x", x)
    axes.set_ylim(-2, 102)
    _titles(axes, axis, "problems solved, %")
    return figure


def grid(panel: Panel, target: Path) -> Figure:
    """The target, and the best, median and worst run of each configuration, with its loss."""
    columns = len(panel.rows) + 1
    lines = max(len(_chosen(row)) for row in panel.rows)
    figure = new_figure(1.15 * columns, 0.3 + 1.2 * lines)
    figure.set_layout_engine("constrained")
    axes = np.asarray(figure.subplots(lines, columns, squeeze=False))
    for each in axes.flat:
        each.set_axis_off()
    _show(axes[0, 0], target, "", "target")
    for column, row in enumerate(panel.rows, start=1):
        for line, (what, run) in enumerate(_chosen(row)):
            title = plain(fitted(row.name, _TITLE)) if line == 0 else ""
            reference = run.folder / "reference.png"  # by which it was judged
            found = reference if reference.exists() else run.folder / "best.png"
            _show(axes[line, column], found, f"{what} {run.final:.3g}", title)
    return figure


def _chosen(row: Row) -> Sequence[tuple[str, StoredRun]]:
    """The best, median (of two the better) and worst run; two of two runs, one of one."""
    ranked = row.ranked
    typical = ranked[(len(ranked) - 1) // 2]
    chosen = [("best", ranked[0]), ("median", typical), ("worst", ranked[-1])]
    return chosen if len(ranked) > 2 else chosen[:1] if len(ranked) == 1 else chosen[::2]


def _show(axes: Any, path: Path, note: str, title: str) -> None:
    try:
        axes.imshow(load(path), vmin=0, vmax=1, interpolation="antialiased")
    except (OSError, ValueError):  # missing or damaged
        note = f"{note} (no picture)"
    axes.set_title(title, fontsize=7, color=INK, loc="left", pad=3)
    axes.text(0, -0.04, note, transform=axes.transAxes, fontsize=6.5, color=MUTED, va="top")


def png(figure: Figure) -> bytes:
    """PNG on white, 160 dots per inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


# -- the parts of a chart --------------------------------------------------------------------------


def _label(name: str) -> str:
    return plain(fitted(name, _LONGEST))


def _canvas() -> tuple[Figure, Any]:
    """Figure and axes; the legend stands on the right."""
    figure = new_figure(7.2, 3.6)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    axes.tick_params(which="both", labelsize=9, colors=MUTED)
    axes.grid(color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(MUTED)
    return figure, axes


def _titles(axes: Any, x: str, y: str) -> None:
    """Names of the axes, and the legend; y stands above, where long numbers cannot displace it."""
    axes.set_xlabel(x, fontsize=10, color=INK)
    axes.set_title(y, fontsize=10, color=INK, loc="left", pad=5)
    if axes.get_legend_handles_labels()[0]:
        axes.figure.legend(loc="outside right upper", fontsize=7, frameon=False, labelcolor=INK,
                           handlelength=2.8)  # fmt: skip


def _scale(axes: Any, which: str, values: Float64) -> None:
    """Logarithmic axis around the positive values, if there are any; zero lies below the plot."""
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
