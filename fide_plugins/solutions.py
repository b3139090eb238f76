"""Distinct candidates of a run directory, best first; nothing in it is executed."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins import encoders
from fide_plugins.errors import CheckpointError, OptionError
from fide_plugins.fitting.pictures import best_compared, picture, side_by_side
from fide_plugins.recording.figures import (
    INK,
    MUTED,
    Panel,
    draw_image,
    figure_as_png,
    plain,
)
from fide_plugins.recording.parameters import read_solutions, rows
from fide_plugins.recording.storage import RunDirectoryError, is_saved, read_run, with_optimizer
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.runtime.schema import IMPOSSIBLE, Schema, array, check
from fide_plugins.types import Float32, Float64, Solution

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE


_KIND, _NAME = "solutions", "solutions.ckpt"
_SCHEMA: Schema = {
    "x": array("n", "d", low=0.0, high=1.0),
    "images": array("n", "H", "W", 3, low=0.0, high=1.0),
}

Known = list[tuple[Float64, Float32]]
"""Points (d,) and their images (H, W, 3)."""


def write_images(directory: Path, points: Sequence[Float64], images: Sequence[Float32]) -> None:
    """Write images (H, W, 3) of points (d,); n >= 1.  Raises OSError."""
    state = {"x": np.array(points), "images": np.array(images)}
    checkpoint.write(directory / _NAME, _KIND, state)


def read_images(directory: Path) -> Known:
    """What was written; nothing if nothing was.  Raises CheckpointError if it is damaged."""
    path = directory / _NAME
    if not path.exists():
        return []
    state: Any = checkpoint.read(path, _KIND)
    try:
        check(state, _SCHEMA, {}, "solutions")
    except IMPOSSIBLE as error:
        raise CheckpointError(f"{path}: impossible contents ({error}); remove it") from error
    return list(zip(state["x"], state["images"], strict=True))


def image_of(known: Known, x: Float64) -> Float32 | None:
    """The image of the point x (d,); None if there is none."""
    return next((image for point, image in known if np.array_equal(point, x)), None)


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
    path = Path(directory)
    run = read_run(path)
    if run is None:
        raise OptionError(f"{path} is no run directory; give one that fide fit or fide run wrote")
    settings = run["settings"]
    if settings.get("optimizer") != "fide":
        raise OptionError(
            f"{path} is a run of {settings.get('optimizer')}, which keeps one solution: its best; "
            "only fide knows several"
        )
    optimizer = _optimizer(path, encoder)
    solutions = optimizer.solutions(k)
    solutions[:1] = [_with_std(one, run) for one in solutions[:1]]
    known = read_images(path)
    images = [image_of(known, one.x) for one in solutions]
    if solutions and images[0] is None:
        best = best_compared(optimizer)
        images[0] = None if best is None else picture(optimizer, best)
    return Found(
        str(settings.get("loss")),
        side_by_side(optimizer.views.targets),
        solutions,
        images,
    )


def _with_std(best: Solution, run: dict[str, Any]) -> Solution:
    """The best solution with the standard deviations that its fit has computed at the end."""
    totals = run.get("totals")
    try:
        kept = read_solutions((totals or {}).get("solutions", []), len(best.x), best.space)
    except (AttributeError, TypeError, ValueError, OverflowError):
        return best
    same = [one.estimate for one in kept if np.array_equal(one.x, best.x)]
    return replace(best, estimate=same[0]) if same else best


def _optimizer(path: Path, encoder: Callable[..., object] | None) -> FIDE:
    from fide_plugins.fide import FIDE

    if not is_saved(path):
        raise RunDirectoryError(
            f"{path} has no checkpoint, in which the solutions are; runs of a comparison keep none"
        )

    def load(file: Path) -> FIDE:
        if encoder is None:
            _check_encoder(file)
        return FIDE.load(file, loss=_no_loss, encoder=encoder)

    return with_optimizer(path, load)


def _check_encoder(path: Path) -> None:
    settings: Any = checkpoint.read(path, "fide").get("settings")
    name = settings.get("encoder") if isinstance(settings, dict) else None
    if isinstance(name, str) and name.partition(":")[0] not in encoders.names():
        raise OptionError(
            f"{path.parent} is a run with an encoder of your own, {name!r}; give it again: "
            f"--encoder FILE.py:{name}"
        )


def _no_loss(images: Any) -> Any:
    """A loss in place of the user's own, which is not needed."""
    return np.zeros(len(images[0] if isinstance(images, list) else images))  # a list of views


_MOST = 24  # lines of parameters


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
