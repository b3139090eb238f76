"""Figures of matplotlib that `Result` returns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.recording.figures import (
    GAIN,
    INK,
    Panel,
    difference,
    draw_curve,
    draw_image,
    figure_as_png,
    plain,
)
from fide_plugins.recording.record import RunResult
from fide_plugins.runtime.messages import counted
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.types import Float32, Float64

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    best = result.image
    panels = [Panel("target", target)]
    for name, image in (("first render", result.first_image), ("best", best)):
        if image is not None:
            squared = np.square(image.astype(np.float64) - target).mean(axis=-1)
            panels.append(Panel(name, image, f"MSE {np.average(squared, weights=counts):.3g}"))
    if best is not None:
        panels.append(Panel(f"{GAIN}x difference", difference(target, best, counts)))
    if result.noisy and result.reference is not None:
        panels.append(Panel("reference", result.reference, f"MSE {result.mse:.3g}"))
    return panels
