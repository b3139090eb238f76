"""Solutions of a run directory.  Its checkpoints are data: nothing in it is executed."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins import encoders
from fide_plugins.errors import OptionError
from fide_plugins.fitting.pictures import side_by_side
from fide_plugins.recording import kept_solutions
from fide_plugins.recording.json_record import RunDirectoryError, read_run
from fide_plugins.recording.run_checkpoint import is_saved, with_optimizer
from fide_plugins.runtime import checkpoint
from fide_plugins.solutions import pictures
from fide_plugins.types import Float32, Solution

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["Found", "read"]


@dataclass(frozen=True, eq=False)
class Found:
    """Solutions of a run, best first.

    loss: name of the loss.
    target: (H, W, 3), views side by side.
    images: (H, W, 3) of each solution, None where none is stored.
    elsewhere: share of a model's hypotheses that are far from all of them; None without a model.
    """

    loss: str
    target: Float32
    solutions: list[Solution]
    images: list[Float32 | None]
    elsewhere: float | None = None


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
    known = pictures.read(path)
    images = [pictures.of(known, one.x) for one in solutions]
    best = optimizer.state.best
    if solutions and images[0] is None and best is not None and best.solution.image is not None:
        images[0] = side_by_side(optimizer.views.unpacked(best.solution.image))
    return Found(
        str(settings.get("loss")),
        side_by_side(optimizer.views.targets),
        solutions,
        images,
        optimizer.elsewhere(solutions),
    )


def _with_std(best: Solution, run: dict[str, Any]) -> Solution:
    """The best solution with the standard deviations that its fit has computed at the end.

    Without them, or where they are of another candidate, they are of samples of the search.
    """
    totals = run.get("totals")
    try:
        kept = kept_solutions.read((totals or {}).get("solutions", []), len(best.x), best.space)
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
    """Raise OptionError if the optimizer at `path` has an encoder that no name stands for."""
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
