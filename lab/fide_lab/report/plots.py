"""Charts and pictures of a report; no window, no global state.

The same figure serves a paper (PNG, SVG) and the page, where a style sheet sets the colors.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from fide_lab.compare.results import StoredRun
from fide_lab.report import statistics
from fide_lab.report.panel import Panel, Row, fitted
from fide_lab.report.tables import number
from fide_plugins.recording.figures import THUMBNAIL, plain, thumbnail
from fide_plugins.recording.record import PARTS
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import load

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure


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
    figure = new_figure(width, height, facecolor="none")
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


# -- figures as files, and as SVG elements of a page -----------------------------------------------
#
# In a page, element ids get a prefix that is unique to the figure, colors become variables that a
# dark theme can change, text uses the font of the page, and elements with a gid get it as class.

VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    RULE: "rule",
    **{color: f"series-{i}" for i, color in enumerate(PALETTE)},
    **{color: f"part-{part}" for part, color in PART_COLORS.items()},
}
"""Color in a figure, and the name of its CSS variable in the page."""


def as_file(figure: Figure) -> bytes:
    """SVG file with text as text and without a date, so that equal figures give equal files."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "fide"}):
        figure.savefig(buffer, format="svg", facecolor="white", metadata={"Date": None})
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """PNG on white, 200 dots per inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def _shortened(path: str) -> str:
    """Path data rounded down to hundredths of a point, after a space."""
    return " " + re.sub(r"(\.\d\d)\d+", r"\1", " ".join(path.split()))


def in_page(file: bytes, name: str, description: str) -> str:
    """SVG element for a page, made from a figure's SVG file.

    name: unique in the page, of letters, digits and "-"; description: text alternative.
    """
    text = file.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r" d=\"[^\"<>]*\"", lambda path: _shortened(path[0]), text)
    text = re.sub(r"\sid=\"(s\d+ \w+|legend)\"", r' class="\1"', text)
    text = re.sub(r"(\sid=\"|url\(#|href=\"#)", rf"\g<1>{name}-", text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var(--{variable})")
    text = re.sub(r"fill: #ffffff", "fill: none", text)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text)
    head = f'<svg role="img" aria-label={quoteattr(description)} '
    size = re.compile(r"<svg width=\"[^\"]*\" height=\"[^\"]*\" |<svg ")
    return size.sub(lambda _: head, text, count=1)  # a function: names may hold backslashes


def markup(file: bytes, name: str, description: str) -> Markup:
    """As `in_page`, for a template, which does not escape it."""
    from markupsafe import Markup

    return Markup(in_page(file, name, description))


# -- images that the runs of a panel found: small ones for the page, one figure for a paper --------

_TITLE = 21  # most characters above a picture of the figure


@dataclass(frozen=True)
class Picture:
    """A small picture of the page: its data URL, its description, and a note shown over it."""

    address: str
    alt: str
    note: str


@dataclass(frozen=True)
class Strip:
    """Pictures of one configuration in a row; None for a missing picture."""

    label: str
    index: int
    pictures: tuple[Picture | None, ...]


def rows_of(panel: Panel) -> list[Strip]:
    """The best, the median and the worst run of each configuration, with their losses."""
    strips = []
    for row in panel.rows:
        chosen = [
            _with_loss(
                _found(run), f"{what} of {len(row.runs)} runs of {row.name}", run.final, what
            )
            for what, run in _chosen(row)
        ]
        strips.append(Strip(row.name, row.index, tuple(chosen)))
    return strips


def grid(panel: Panel, target: Path) -> Figure:
    """Figure for a paper: target, and the best, median and worst run of each configuration."""
    columns = len(panel.rows) + 1
    lines = max(len(_chosen(row)) for row in panel.rows)
    height = 0.3 + 1.2 * lines
    figure = new_figure(1.15 * columns, height)
    room = {"left": 0.02, "right": 0.98, "top": 1 - 0.2 / height, "bottom": 0.2 / height,
            "wspace": 0.06, "hspace": 0.14}  # fmt: skip
    axes = np.asarray(figure.subplots(lines, columns, squeeze=False, gridspec_kw=room))
    for each in axes.flat:
        each.set_axis_off()
    _show(axes[0, 0], _load(target), "", "target")
    for column, row in enumerate(panel.rows, start=1):
        for line, (what, run) in enumerate(_chosen(row)):
            title = plain(fitted(row.name, _TITLE)) if line == 0 else ""
            _show(axes[line, column], _load(_found(run)), f"{what} {run.final:.3g}", title)
    return figure


def picture(path: Path, alt: str, note: str = "", side: int = THUMBNAIL) -> Picture | None:
    """The picture at `path`, reduced to `side` pixels; None if it is missing or damaged."""
    image = _load(path)
    return None if image is None else Picture(_address(thumbnail(image, side)), alt, note)


def _with_loss(
    path: Path, alt: str, loss: float, what: str = "", side: int = THUMBNAIL
) -> Picture | None:
    return picture(path, f"{alt}, loss {loss:.3g}", f"{what} {loss:.3g}".strip(), side)


def _chosen(row: Row) -> Sequence[tuple[str, StoredRun]]:
    """The best, the median and the worst run; two of two runs, one of one."""
    ranked = row.ranked
    chosen = [("best", ranked[0]), ("median", row.typical), ("worst", ranked[-1])]
    return chosen if len(ranked) > 2 else chosen[:1] if len(ranked) == 1 else chosen[::2]


def _found(run: StoredRun) -> Path:
    """File of the image by which a run was judged."""
    reference = run.folder / "reference.png"
    return reference if reference.exists() else run.folder / "best.png"


def _load(path: Path) -> Float32 | None:
    try:
        return load(path)
    except (OSError, ValueError):
        return None


def _address(image: Float32) -> str:
    """The image as a data URL in WebP, the smallest format for small pictures."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.rint(image * 255.0).astype(np.uint8)).save(buffer, "WEBP", quality=85)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def _show(axes: Any, image: Float32 | None, note: str, title: str) -> None:
    if image is not None:
        axes.imshow(image, vmin=0, vmax=1, interpolation="antialiased")
    axes.set_title(title, fontsize=7, color=INK, loc="left", pad=3)
    if note:
        axes.text(0, -0.04, note, transform=axes.transAxes, fontsize=6.5, color=MUTED, va="top")
