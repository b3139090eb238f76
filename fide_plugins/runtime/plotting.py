"""Matplotlib, which the extra plot installs; no window opens, and no global state changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fide_plugins.runtime.machine import missing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
