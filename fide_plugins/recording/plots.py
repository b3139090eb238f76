"""Figures of matplotlib that `Result` returns; no window opens, and no global state changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fide_plugins.recording.figures import (
    GAIN,
    INK,
    Panel,
    arrangement,
    difference,
    draw_curve,
    draw_image,
    figure_as_png,
    plain,
)
from fide_plugins.recording.record import RunResult
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import counted
from fide_plugins.types import Float32, Float64

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as MatplotlibFigure
except ImportError as error:
    raise missing("plot", "figures need matplotlib") from error

_WIDTH, _PICTURES, _LOSS = 10.0, 4.5, 2.3  # inches


class Figure(MatplotlibFigure):
    """A figure that a notebook shows, whether or not pyplot is loaded."""

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), dpi=100, facecolor="white", layout="constrained")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        return figure_as_png(self)


def result_figure(panels: Sequence[Panel], losses: Float64, loss: str) -> Figure:
    """Figure of pictures, and of losses (n,) by their name."""
    n_rows, n_columns, height = arrangement(panels, _WIDTH, _PICTURES)
    figure = Figure(_WIDTH, height + _LOSS)
    parts: Any = figure.subfigures(2, 1, height_ratios=[height, _LOSS])
    pictures = parts[0].subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, panel in zip(pictures, panels, strict=True):
        draw_image(axes, panel)
    draw_curve(parts[1].subplots(), losses, loss)
    return figure


def curve_figure(losses: Float64, loss: str) -> Figure:
    """Small figure of losses (n,) by their name."""
    figure = Figure(5.0, 1.9)
    draw_curve(figure.subplots(), losses, loss)
    return figure


def summary(result: RunResult, target: Float32, counts: Float32 | None = None) -> bytes:
    """PNG with the target, the first render, the best image, what is left, and the losses.

    counts: (H, W), weights of the pixels; None: all are alike.
    """
    figure = result_figure(_panels(result, target, counts), result.losses, result.loss)
    facts = f"{counted(result.parameters, 'parameter')}   {result.evaluations:,} renders"
    title = f"{plain(result.task)}, fitted by {plain(result.optimizer)}"
    seed = f"seed {result.seed}   {result.wall_s:.1f} s"
    figure.suptitle(f"{title}   ({facts}   {seed})", fontsize=11, color=INK)
    return figure_as_png(figure)


def _panels(result: RunResult, target: Float32, counts: Float32 | None) -> list[Panel]:
    start, best = result.first_image, result.image
    panels = [Panel("target", target)]
    for name, image in (("first render", start), ("best", best)):
        if image is not None:
            panels.append(Panel(name, image, _mse(image, target, counts)))
    if best is not None:
        panels.append(Panel(f"{GAIN}x difference", difference(target, best, counts)))
    if result.noisy and result.reference is not None:
        panels.append(Panel("reference", result.reference, f"MSE {result.mse:.3g}"))
    return panels


def _mse(image: Float32, target: Float32, counts: Float32 | None) -> str:
    """Mean squared error of an image, weighted by the weights (H, W) of its pixels, as a text."""
    squared = np.square(image.astype(np.float64) - target).mean(axis=-1)
    return f"MSE {np.average(squared, weights=counts):.3g}"
