"""A result as HTML, for notebooks: everything in one piece, no script, no link."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from contextlib import suppress
from html import escape
from typing import TYPE_CHECKING

from fide_plugins.errors import DependencyError
from fide_plugins.recording.figures import Panel, as_png, thumbnail
from fide_plugins.recording.parameters import ROUGH, Row, is_rough, rows

if TYPE_CHECKING:
    from fide_plugins.fitting.result import Result

__all__ = ["page"]

_SIDE, _WIDE = 160, 480  # pixels of a picture: its longer side; of several views side by side
_MOST = 40  # parameters


def page(result: Result, panels: Sequence[Panel]) -> str:
    """HTML of a result: its status, pictures, losses, and parameters in their units."""
    failed = f", {result.failures:,} renders failed" if result.failures else ""
    facts = (
        f"{result.evaluations:,} renders in {result.seconds:.1f} s, "
        f"stopped: {result.stopped}{failed}"
    )
    pictures = "".join(map(_picture, panels))
    with suppress(DependencyError):  # without matplotlib, which is an extra
        from fide_plugins.recording.plots import curve_figure

        if len(result.losses):
            curve = curve_figure(result.losses, result.loss)._repr_png_()
            pictures += f'<img alt="losses" src="{_inline(curve)}" style="height:165px">'
    rough = f"<p>{ROUGH}</p>" if result.best is not None and is_rough(result.best) else ""
    return (
        f"<div><p><b>{escape(str(result.status))}</b><br>{escape(facts)}</p>"
        f'<div style="display:flex;flex-wrap:wrap;gap:8px;align-items:flex-end">{pictures}</div>'
        f"{_table(rows([] if result.best is None else [result.best]))}{rough}</div>"
    )


def _picture(panel: Panel) -> str:
    height, breadth = panel.image.shape[:2]
    side = _WIDE if breadth > 2 * height else _SIDE
    shown = round(side * breadth / max(height, breadth))
    source = _inline(as_png(thumbnail(panel.image, side)))
    name = escape(panel.name)
    return (
        f'<figure style="margin:0"><figcaption>{name}</figcaption><img alt="{name}" '
        f'src="{source}" style="width:{shown}px;image-rendering:pixelated"></figure>'
    )


def _table(table: list[Row]) -> str:
    cells = "".join(
        f"<tr><td>{escape(row.name)}</td><td>{escape(row.values[0])}</td>"
        f"<td>{escape(row.unit)}</td>"
        f"<td>{'' if row.determined else 'not determined by the picture'}</td></tr>"
        for row in table[:_MOST]
    )
    if len(table) > _MOST:
        cells += f"<tr><td>... {len(table) - _MOST} more</td></tr>"
    return f"<table>{cells}</table>" if cells else ""


def _inline(png: bytes) -> str:
    return f"data:image/png;base64,{b64encode(png).decode()}"
