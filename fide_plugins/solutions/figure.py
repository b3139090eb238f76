"""The picture of several solutions: the target, then each with its loss and its parameters."""

from __future__ import annotations

import io
from typing import Any

from fide_plugins.recording.figures import plain
from fide_plugins.recording.parameters import Row, rows
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.solutions import Found
from fide_plugins.types import Float32

__all__ = ["figure"]

_INK, _MUTED = "#1a1a1a", "#6b7280"
_WIDTH = 2.4  # inches of one panel
_LINE = 0.16  # inches of a line of text
_MOST = 24  # lines of parameters
_NO_IMAGE = "no image stored\n(fide fit renders them,\nfit(out=) does not)"


def figure(found: Found) -> bytes:
    """PNG of the target and the solutions, side by side; no window, no global state."""
    table = rows(found.solutions)
    shape = found.target.shape
    panel = _WIDTH * shape[0] / shape[1]
    lines = min(len(table), _MOST) + (len(table) > _MOST)
    height = panel + 0.75 + _LINE * lines
    columns = 1 + len(found.solutions)
    canvas = new_figure(_WIDTH * columns * 1.06, height, dpi=110)
    top = 1 - 0.5 / height
    grid = canvas.add_gridspec(
        1, columns, left=0.01, right=0.99, top=top, bottom=top - panel / height, wspace=0.06
    )
    _panel(canvas.add_subplot(grid[0, 0]), "target", "", found.target)
    for i, (solution, image) in enumerate(zip(found.solutions, found.images, strict=True)):
        axes = canvas.add_subplot(grid[0, i + 1])
        _panel(axes, f"{i + 1}", f"loss {solution.loss:.3g}", image)
        _lines(canvas, axes, table, i, height)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _panel(axes: Any, name: str, note: str, image: Float32 | None) -> None:
    axes.set_title(name, fontsize=10, color=_INK, loc="left", pad=4)
    axes.set_title(note, fontsize=8, color=_MUTED, loc="right", pad=4)
    if image is None:
        axes.text(0.5, 0.5, _NO_IMAGE, fontsize=8, color=_MUTED, ha="center", va="center")
    else:
        axes.imshow(image, vmin=0, vmax=1, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#d4d4d8")


def _lines(canvas: Any, axes: Any, table: list[Row], i: int, height: float) -> None:
    """Write the parameters of solution i below its image; muted, what is not determined."""
    box = axes.get_position()
    shown = [(f"{row.label}  {row.values[i]}", row.determined) for row in table[:_MOST]]
    if len(table) > _MOST:
        shown.append((f"... {len(table) - _MOST} more", True))
    for k, (text, determined) in enumerate(shown):
        canvas.text(
            box.x0, box.y0 - (0.14 + _LINE * k) / height, plain(text),
            fontsize=7, color=_INK if determined else _MUTED, va="top",
            style="normal" if determined else "italic",
        )  # fmt: skip
