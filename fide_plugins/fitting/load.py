"""Results from run directories, which may be anybody's: nothing in them is executed."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fide_plugins.errors import FideError, ImageError, OptionError
from fide_plugins.fitting.result import Result, histories
from fide_plugins.fitting.run_files import optimizer_in
from fide_plugins.recording import kept_solutions
from fide_plugins.recording.directory import TARGET_VALUES
from fide_plugins.recording.json_record import RunDirectoryError, read_run
from fide_plugins.recording.record import Record
from fide_plugins.recording.run_checkpoint import is_saved, read_record
from fide_plugins.runtime import files
from fide_plugins.runtime.schema import IMPOSSIBLE
from fide_plugins.space import Space
from fide_plugins.status import Status
from fide_plugins.types import Float32, Solution
from fide_plugins.validation import image_files, images
from fide_plugins.validation.pixels import ValueRange, restored, value_range_of

__all__ = ["load_run"]


def load_run(directory: str | os.PathLike[str]) -> Result:
    """Result of the run in a directory that `fit`, `fide fit` or `fide run` wrote.

    It may be finished, interrupted or under way: the newest checkpoint counts.  Nothing in the
    directory is executed, so it may be anybody's.

    Raises OptionError for a directory without a run; RunDirectoryError (a FileExistsError) if its
    record is damaged or no checkpoint is there, as of runs of a comparison; CheckpointError for a
    damaged checkpoint; ImageError for a damaged picture; OSError.
    """
    path = Path(directory)
    run = read_run(path)
    if run is None:
        raise OptionError(f"{path} is no run directory; give one that fit(out=) or fide fit wrote")
    if not is_saved(path):
        raise RunDirectoryError(
            f"{path} has no checkpoint yet, or kept none, as runs of a comparison: no result to "
            "read; look at its summary.png and curve.csv"
        )
    try:
        return _read(path, run)
    except (FideError, OSError):
        raise
    except IMPOSSIBLE as error:
        raise RunDirectoryError(
            f"{path / 'run.json'} has impossible contents ({error}); copy that file back"
        ) from error


def _read(path: Path, run: dict[str, Any]) -> Result:
    settings = run["settings"]
    dim = int(settings["dim"])
    space = None if settings.get("space") is None else Space.from_dict(settings["space"])
    views = (run.get("facts") or {}).get("views")
    record, _ = read_record(path, dim, settings["size"])
    totals = _totals(run, record)
    known = _known(path, settings, totals, dim, space)
    values = _values(settings)
    best = _best(record, known.solutions, space, views, values)
    return Result(
        best=best,
        params=None if best is None else best.params or totals.get("params") or best.x.copy(),
        solutions=known.solutions if best is None else [best, *known.solutions[1:]],
        status=known.status,
        target=_target(path, views, values),
        weights=known.weights,
        loss=str(settings.get("loss")),
        failures=record.failures,
        clipped=int(totals.get("clipped", 0)),
        value_range=None if values is None else (values.low, values.high),
        first_failure=None,
        busy=math.nan,
        stopped=str((totals and run.get("stopped")) or run.get("state")),
        out=path,
        **histories(record, dim),
    )


def _totals(run: dict[str, Any], record: Record) -> dict[str, Any]:
    """Totals of the state that the checkpoint holds; empty if they are those of an earlier call."""
    totals = run.get("totals")
    if run.get("state") == "running" or not isinstance(totals, dict):
        return {}
    return totals if totals.get("evaluations") == record.evaluations else {}


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"a text is {value!r}")
    return value


class _Known(NamedTuple):
    """What only the optimizer knows."""

    solutions: list[Solution]
    status: Status
    weights: Any


def _known(
    path: Path, settings: dict[str, Any], totals: dict[str, Any], dim: int, space: Space | None
) -> _Known:
    """From the totals, as it was at the end; what they lack from the optimizer, if it loads."""
    solutions = kept_solutions.read(totals.get("solutions", []), dim, space)
    status = None
    if "status" in totals:
        status = Status(_text(totals["status"]), _text(totals["sentence"]))
    if solutions and status is not None and settings.get("weights") is None:
        return _Known(solutions, status, None)
    try:
        optimizer = optimizer_in(path)
    except FideError:  # it needs an encoder of the user's
        optimizer = None
    if optimizer is None:
        nothing = Status("unknown", "What the optimizer knew of the run is not recorded.")
        return _Known(solutions, status or nothing, None)
    return _Known(solutions or optimizer.solutions(), status or optimizer.status, optimizer.weights)


def _best(
    record: Record,
    solutions: list[Solution],
    space: Space | None,
    views: Any,
    values: ValueRange | None,
) -> Solution | None:
    """The best candidate, with what the solutions know of it."""
    if record.x_best is None:
        return None
    known = next((one for one in solutions if np.array_equal(one.x, record.x_best)), None)
    return Solution(
        record.x_best,
        record.best_loss,
        record.best_evaluation,
        None if record.image is None else restored(unpacked(record.image, views), values),
        None if known is None else known.probability,
        space,
        None if known is None else known.estimate,
    )


def _values(settings: dict[str, Any]) -> ValueRange | None:
    values = value_range_of(settings.get("value_range"))
    if isinstance(values, str):
        raise TypeError(f"the range of values is {values!r}")
    return values


def unpacked(image: Float32, views: Any) -> Any:
    """Views of a packed image, as `Views` packs them; views: their sizes, None for one."""
    if views is None:
        return image
    ends = np.cumsum([height * width for height, width in views])
    parts = np.split(image, ends[:-1])
    return [part.reshape(*size, 3) for part, size in zip(parts, views, strict=True)]


def _target(path: Path, views: Any, values: ValueRange | None) -> Any:
    """Target in the user's values, or targets; of a run of an earlier version rounded to 8 bits."""
    file = path / TARGET_VALUES
    if values is None or not file.exists():
        return restored(_cut(_picture(path / "target.png"), views), values)
    files.check_regular(file)
    pixels = image_files.read_pixels(file, None, raw=True)
    if pixels.dtype != np.float32 or pixels.shape[2:] != (3,) or not np.isfinite(pixels).all():
        raise ImageError(f"{file} is no picture of finite 32-bit floats in RGB; copy it back")
    return _cut(pixels, views)


def _picture(path: Path) -> Float32:
    if path.exists():
        files.check_regular(path)  # Pillow would wait for a pipe
    return images.load(path)


def _cut(picture: Float32, views: Any) -> Any:
    """Views of a picture of them side by side."""
    if views is None:
        return picture
    parts = np.split(picture, np.cumsum([width for _, width in views])[:-1], axis=1)
    return [part[:height] for part, (height, _) in zip(parts, views, strict=True)]
