"""Figures of runs by matplotlib, which the extra plot installs, and HTML; no window, no state."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.fitting.pictures import counting, side_by_side
from fide_plugins.fitting.result import Result
from fide_plugins.recording.parameters import ROUGH, is_rough, rows
from fide_plugins.recording.record import Record, best_so_far
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import counted
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.image_files import encoded
from fide_plugins.validation.values import ValueRange

if TYPE_CHECKING:
    from matplotlib.figure import Figure

THUMBNAIL = 160
"""Longer side of a thumbnail, pixels."""

GAIN = 4
"""By how much a picture of a difference is stronger than the difference."""


def thumbnail(image: Float32, side: int = THUMBNAIL) -> Float32:
    """The image (H, W, 3), reduced if its longer side has more than `side` pixels."""
    from fide_plugins.runtime.opencv import cv2

    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale >= 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


@dataclass(frozen=True, eq=False)
class Panel:
    """A picture (H, W, 3) in [0, 1] of a figure, with its name and a note."""

    name: str
    image: Float32
    note: str = ""


def difference(target: Float32, image: Float32, counts: Float32 | None = None) -> Float32:
    """Difference of two pictures (H, W, 3), `GAIN` times as strong, where `counts` is not 0."""
    apart: Float32 = np.clip(GAIN * np.abs(target - image), 0, 1).astype(np.float32)
    if counts is not None:
        apart[np.asarray(counts) == 0] = 0
    return apart


INK, MUTED, ACCENT = "#1a1a1a", "#8a8f98", "#c2410c"


def new_figure(width: float, height: float, *, dpi: int = 100, facecolor: str = "white") -> Figure:
    """An empty figure, width and height in inches; DependencyError without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing("plot", "figures need matplotlib") from error
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=facecolor)
    FigureCanvasAgg(figure)
    return figure


def figure_as_png(figure: Any) -> bytes:
    """PNG of a figure of matplotlib."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def draw_image(axes: Any, panel: Panel) -> None:
    """Draw a picture with its name."""
    large = max(panel.image.shape[:2]) >= 300
    axes.imshow(panel.image, vmin=0, vmax=1, interpolation="antialiased" if large else "nearest")
    axes.set_title(panel.name, fontsize=11, color=INK, loc="left", pad=4)
    axes.set_title(panel.note, fontsize=9, color=MUTED, loc="right", pad=4)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#d4d4d8")


def draw_curve(axes: Any, losses: Float64, loss: str) -> None:
    """Draw every loss (n,) as a dot, the best one so far as a line; loss: its name."""
    finite = np.isfinite(losses)
    index = np.arange(1, len(losses) + 1)
    if finite.any():
        best = best_so_far(losses)
        shown = np.flatnonzero(finite)[:: max(1, int(finite.sum()) // 4000)]
        if losses[finite].min() >= 0 and losses[finite].max() > 0:
            axes.set_yscale("log", nonpositive="clip")
        axes.scatter(index[shown], losses[shown], s=3, color=MUTED, alpha=0.35,
                     linewidths=0, label="each render", rasterized=True)  # fmt: skip
        axes.step(index, np.where(np.isfinite(best), best, np.nan), where="post",
                  color=ACCENT, linewidth=2, label="best so far")  # fmt: skip
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncol=2, borderpad=0.2,
                    fontsize=8, frameon=False, markerscale=3)  # fmt: skip
    axes.set_xlim(0, max(2, len(losses)))
    axes.set_xlabel("renders", fontsize=9, color=INK, labelpad=2)
    axes.set_title(f"loss ({plain(loss)})", fontsize=9, color=INK, loc="left", pad=4)
    axes.tick_params(which="both", labelsize=8, colors=MUTED)
    axes.grid(axis="y", color="#e4e4e7", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def plain(text: str) -> str:
    """`text`, escaped so that matplotlib does not read it as a formula."""
    return text.replace("\\", "").replace("$", r"\$")


_WIDTH, _PICTURES, _LOSS, _TITLE = 10.0, 4.5, 2.3, 0.4  # inches; pictures: at most


def result_figure(panels: Sequence[Panel], losses: Float64, loss: str) -> Figure:
    """Figure of pictures in a row, and of losses (n,) by their name."""
    height, breadth = panels[0].image.shape[:2]
    high = min(_WIDTH / len(panels) * height / breadth, _PICTURES) + _TITLE
    figure = new_figure(_WIDTH, high + _LOSS)
    figure.set_layout_engine("constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[high, _LOSS])
    pictures = parts[0].subplots(1, len(panels), squeeze=False).ravel()
    for axes, panel in zip(pictures, panels, strict=True):
        draw_image(axes, panel)
    draw_curve(parts[1].subplots(), losses, loss)
    # a notebook shows it so, whether or not pyplot is loaded
    figure._repr_png_ = partial(figure_as_png, figure)  # type: ignore[attr-defined]
    return figure


def summary(
    settings: Mapping[str, Any],
    record: Record,
    target: Float32,
    first: Float32 | None,
    best: Float32 | None,
    counts: Float32 | None = None,
    more: Sequence[Panel] = (),
) -> bytes:
    """PNG of a run with these settings: target, first render, best image, what is left, losses.

    counts: (H, W), weights of the pixels; None: all are alike.  more: further pictures.
    """
    panels = [Panel("target", target)]
    for name, image in (("first render", first), ("best", best)):
        if image is not None:
            squared = np.square(image.astype(np.float64) - target).mean(axis=-1)
            panels.append(Panel(name, image, f"MSE {np.average(squared, weights=counts):.3g}"))
    if best is not None:
        panels.append(Panel(f"{GAIN}x difference", difference(target, best, counts)))
    figure = result_figure([*panels, *more], np.array(record.losses), settings["loss"])
    space = settings.get("space")
    number = settings["dim"] if space is None else len(Space.from_dict(space).names)
    facts = f"{counted(number, 'parameter')}   {record.evaluations:,} renders"
    title = f"{plain(settings['task'])}, fitted by {plain(settings['optimizer'])}"
    seed = f"seed {settings['seed']}   {record.wall_s:.1f} s"
    figure.suptitle(f"{title}   ({facts}   {seed})", fontsize=11, color=INK)
    return figure_as_png(figure)


# -- what a fit has found --------------------------------------------------------------------------


def of_result(result: Result) -> Figure:
    """Figure of target, best image, difference, losses."""
    return result_figure(_panels_of(result), result.losses, result.loss)


def html_of(result: Result) -> str:
    """HTML of what a fit has found: status, pictures, and parameters in their units."""
    best, table = result.best, rows([] if result.best is None else [result.best])
    lines = [
        [row.name, row.values[0], row.unit, "" if row.determined else "not determined"]
        for row in table[:_MOST]
    ]
    cells = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in line)}</tr>" for line in lines
    )
    more = f"<p>... {len(table) - _MOST} more</p>" if len(table) > _MOST else ""
    more += f"<p>{ROUGH}</p>" if best is not None and is_rough(best) else ""
    return (
        f"<div><p><b>{escape(str(result.status))}</b><br>{escape(result.facts)}</p>"
        '<div style="display:flex;flex-wrap:wrap;gap:8px;align-items:flex-end">'
        f"{''.join(map(_picture, _panels_of(result)))}</div><table>{cells}</table>{more}</div>"
    )


def _shown(result: Result, image: Any) -> Float32:
    if result.value_range is None:
        return side_by_side(image)
    values = ValueRange(*result.value_range)
    listed = image if isinstance(image, list) else [image]
    return side_by_side([np.clip(values.scaled(one), 0.0, 1.0) for one in listed])


def _panels_of(result: Result) -> list[Panel]:
    target = _shown(result, result.target)
    panels = [Panel("target", target)]
    if result.best is not None and result.best.image is not None:
        image = _shown(result, result.best.image if result.compared is None else result.compared)
        apart = difference(target, image, counting(result.weights, result.target))
        panels += [Panel("best", image), Panel(f"{GAIN}x difference", apart)]
    return panels


_SIDE, _WIDE = 160, 480  # pixels of a picture: its longer side; of several views side by side
_MOST = 40  # parameters


def _picture(panel: Panel) -> str:
    height, breadth = panel.image.shape[:2]
    side = _WIDE if breadth > 2 * height else _SIDE
    shown = round(side * breadth / max(height, breadth))
    source = b64encode(encoded(thumbnail(panel.image, side), ".png")).decode()
    name = escape(panel.name)
    return (
        f'<figure style="margin:0"><figcaption>{name}</figcaption><img alt="{name}" '
        f'src="data:image/png;base64,{source}" '
        f'style="width:{shown}px;image-rendering:pixelated"></figure>'
    )
