"""Images that the runs of a panel found: small pictures for the page, one figure for a paper."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_lab.compare.results import StoredRun
from fide_lab.report.labels import fitted
from fide_lab.report.panel import Panel, Row
from fide_lab.report.plots import INK, MUTED
from fide_plugins.recording.figures import THUMBNAIL, plain, thumbnail
from fide_plugins.types import Float32
from fide_plugins.validation.images import load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Picture", "Strip", "film", "grid", "picture", "rows_of"]

_FRAME = 100  # pixels of the longer side of a film frame, its size on the page
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


def film(panel: Panel) -> tuple[list[int], list[Strip]]:
    """Marks (numbers of renders), and the best image so far of each median run at each mark.

    The marks are those of the longest runs.  The end of a shorter run is shown under the next mark,
    with its own number of renders.
    """
    found = {row.label: _frames(row.typical) for row in panel.rows}
    longest = max(panel.rows, key=lambda row: row.budget)
    marks = sorted(found[longest.label])
    strips = []
    for row in panel.rows:
        places = {_place(mark, marks): mark for mark in sorted(found[row.label])}
        shown = (_frame(row, found[row.label], places.get(mark), mark) for mark in marks)
        strips.append(Strip(row.name, row.index, tuple(shown)))
    return marks, strips


def _place(mark: int, marks: Sequence[int]) -> int:
    """The first of `marks` that is at least `mark`."""
    return next((place for place in marks if place >= mark), mark)


def grid(panel: Panel, target: Path) -> Figure:
    """Figure for a paper: target, and the best, median and worst run of each configuration."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = len(panel.rows) + 1
    lines = max(len(_chosen(row)) for row in panel.rows)
    height = 0.3 + 1.2 * lines
    figure = Figure(figsize=(1.15 * columns, height), facecolor="white")
    FigureCanvasAgg(figure)
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


def _frame(row: Row, frames: dict[int, Path], mark: int | None, place: int) -> Picture | None:
    """The best image of the median run after `mark` renders, under the mark `place`."""
    if mark is None or row.typical.curve is None:
        return None
    loss = row.typical.curve.loss_at("renders", mark)
    note = "" if mark == place else f"{mark}:"
    return _with_loss(frames[mark], f"{row.name} after {mark} renders", loss, note, _FRAME)


def _chosen(row: Row) -> Sequence[tuple[str, StoredRun]]:
    """The best, the median and the worst run; two of two runs, one of one."""
    ranked = row.ranked
    chosen = [("best", ranked[0]), ("median", row.typical), ("worst", ranked[-1])]
    return chosen if len(ranked) > 2 else chosen[:1] if len(ranked) == 1 else chosen[::2]


def _found(run: StoredRun) -> Path:
    """File of the image by which a run was judged."""
    reference = run.folder / "reference.png"
    return reference if reference.exists() else run.folder / "best.png"


def _frames(run: StoredRun) -> dict[int, Path]:
    """Files of a run's film frames by number of renders."""
    found = {}
    for path in run.folder.glob("frame-*.png"):
        number = re.fullmatch(r"frame-(\d+)", path.stem)
        if number:
            found[int(number[1])] = path
    return found


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
