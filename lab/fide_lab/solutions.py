"""Distinct candidates of a run directory, best first; nothing in it is executed."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fide_lab.figures import (
    INK,
    MUTED,
    Panel,
    draw_image,
    figure_as_png,
    new_figure,
    plain,
)
from fide_plugins.errors import CheckpointError, ImageError
from fide_plugins.fitting.fitting import Fitting
from fide_plugins.fitting.pictures import as_compared, best_compared, picture, side_by_side
from fide_plugins.fitting.rendering import Rendered
from fide_plugins.fitting.result import opened
from fide_plugins.fitting.workers import gathered, workers_for
from fide_plugins.recording.parameters import rows, with_std
from fide_plugins.recording.storage import RunDirectoryError, impossible
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE, Schema, array, check
from fide_plugins.types import Float32, Float64, Solution

_KIND, _NAME = "solutions", "solutions.ckpt"
_MOST = 24  # lines of parameters in the figure
_SCHEMA: Schema = {
    "x": array("n", "d", low=0.0, high=1.0),
    "images": array("n", "H", "W", 3, low=0.0, high=1.0),
}


def keep_pictures(fitting: Fitting, workers: int | None, result: Any, out: Path) -> None:
    """Render further solutions for `fide solutions`; those that fail stay without an image."""
    X = np.array([one.x for one in result.solutions[1:]])
    if not len(X):
        return
    number = 0 if workers == 0 else min(fitting.workers.number, len(X))
    with closing(workers_for(fitting.renderer, number, None, fitting.timeout)) as pool:
        outcomes = list(gathered(pool, X, fitting.timeout))
    kept: dict[str, list[Any]] = {"x": [], "images": []}
    for x, outcome in zip(X, outcomes, strict=True):
        if isinstance(outcome, Rendered):
            with suppress(ImageError):  # no image that fits is a render that failed, too
                image = as_compared(result.optimizer, outcome.image)
                kept["images"].append(picture(result.optimizer, image))
                kept["x"].append(x)
    if kept["x"]:
        state = {name: np.array(arrays) for name, arrays in kept.items()}
        checkpoint.write(out / _NAME, _KIND, state)


def _read_images(directory: Path) -> list[tuple[Float64, Float32]]:
    """Points (d,) and their images (H, W, 3), as far as `fide fit` stored any."""
    path = directory / _NAME
    if not path.exists():
        return []
    state: Any = checkpoint.read(path, _KIND)
    try:
        check(state, _SCHEMA, {}, "solutions")
    except IMPOSSIBLE as error:
        raise CheckpointError(f"{path}: impossible contents ({error}); remove it") from error
    return list(zip(state["x"], state["images"], strict=True))


@dataclass(frozen=True, eq=False)
class Found:
    """Solutions of a run, best first.

    loss: name of the loss.
    target: (H, W, 3), views side by side.
    images: (H, W, 3) of each solution, None where none is stored.
    """

    loss: str
    target: Float32
    solutions: list[Solution]
    images: list[Float32 | None]


def read(
    directory: str | os.PathLike[str], k: int = 5, encoder: Callable[..., object] | None = None
) -> Found:
    """Up to k solutions of the run in a directory.

    encoder: the user's own with which it was made; None: a named one.

    Raises OptionError for a directory without a run, or with one of another optimizer than FIDE,
    which alone knows several, and where the encoder must be given; CheckpointError if its
    checkpoint is damaged, or if the encoder is another (all ValueErrors); RunDirectoryError (a
    FileExistsError) if no checkpoint was kept; other OSErrors.
    """
    path, run, optimizer = opened(directory, encoder)
    with impossible(path / "run.json", RunDirectoryError):
        solutions = with_std(optimizer.solutions(k), run)
    known = _read_images(path)
    images = [
        next((image for x, image in known if np.array_equal(x, one.x)), None) for one in solutions
    ]
    if solutions and images[0] is None:
        best = best_compared(optimizer)
        images[0] = None if best is None else picture(optimizer, best)
    return Found(
        str(run["settings"].get("loss")),
        side_by_side(optimizer.views.targets),
        solutions,
        images,
    )


def figure(found: Found) -> bytes:
    """PNG of the target and the solutions, side by side, with their parameters."""
    table, columns = rows(found.solutions), 1 + len(found.solutions)
    panel = 2.4 * found.target.shape[0] / found.target.shape[1]  # inches
    text = 0.16 * min(len(table), _MOST + 1) + 0.2
    canvas = new_figure(2.5 * columns, panel + text + 0.5, dpi=110)
    canvas.set_layout_engine("constrained")
    grid = canvas.subplots(2, columns, squeeze=False, height_ratios=[panel, text])
    draw_image(grid[0, 0], Panel("target", found.target))
    for axes in grid[1]:
        axes.axis("off")
    for i, (solution, image) in enumerate(zip(found.solutions, found.images, strict=True)):
        note = f"loss {solution.loss:.3g}" if image is not None else "no image stored"
        shown = np.ones_like(found.target) if image is None else image
        draw_image(grid[0, i + 1], Panel(f"{i + 1}", shown, note))
        lines = [(f"{row.label}  {row.values[i]}", row.determined) for row in table[:_MOST]]
        if len(table) > _MOST:
            lines.append((f"... {len(table) - _MOST} more", True))
        for k, (line, determined) in enumerate(lines):
            grid[1, i + 1].annotate(
                plain(line), (0, 1), (0, -11.5 * k), "axes fraction", "offset points",
                fontsize=7, color=INK if determined else MUTED, va="top",
                style="normal" if determined else "italic",
            )  # fmt: skip
    return figure_as_png(canvas)
