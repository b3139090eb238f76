"""The run directory of a fit: that of any other run, see `recording.directory`."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.pictures import best_compared, counting, picture, shown, side_by_side
from fide_plugins.fitting.result import Result, opened, result_from
from fide_plugins.recording.directory import RunDirectory, try_each
from fide_plugins.recording.parameters import solutions_as_data, with_std
from fide_plugins.recording.record import Record, totals_of
from fide_plugins.recording.storage import RunDirectoryError, impossible, read_record, read_run
from fide_plugins.runtime.registry import own_name
from fide_plugins.types import Float32, Solution

_CONTENTS = ("mask", "weights", "value_range")
"""Options that are recorded by what they are, not as they are given."""


class SavedRun(RunDirectory):
    """The run directory of a fit."""

    @property
    def lines(self) -> list[str]:
        """Lines of the plan that the run was begun with, see `Result.plan`."""
        return list((self._run.get("totals") or {}).get("plan", ()))

    def begin(self, optimizer: FIDE) -> Record | None:
        """Restore the optimizer, and write what is known; the record that was saved, if any."""
        with ExitStack() as refused:
            refused.callback(self.close)
            restored = self.restore(optimizer.continue_from)
            target = optimizer.evaluator.full.target
            self.write_target(picture(optimizer, target), _in_user_values(optimizer, target))
            self.write_run()
            refused.pop_all()
        return None if restored is None else restored[0]

    def leave(
        self,
        state: str,
        stopped: str,
        record: Record,
        optimizer: FIDE,
        solutions: Sequence[Solution],
        plan: Sequence[str] = (),
    ) -> None:
        """Write totals and the summary; stopped, solutions, plan: see `Result`."""
        image = None if record.image is None else best_compared(optimizer)
        known = totals_of(
            self.settings,
            record,
            budget=self.budget or record.evaluations,
            mse=math.nan if image is None else optimizer.views.squared_error(image),
        )
        if optimizer.space is not None and record.x_best is not None:
            known["params"] = optimizer.space.decode(record.x_best)
        totals = {
            **known,
            **optimizer.status.to_dict(),
            "failures": record.failures,
            "clipped": optimizer.clipped,
            "cost": record.cost,
            **({"plan": list(plan)} if plan else {}),
            "solutions": solutions_as_data(solutions),
        }
        writes = [
            lambda: self._draw_summary(record, optimizer, image),
            lambda: self.write_run(state, totals, stopped),
        ]
        if not record.evaluations:
            del writes[0]
        try_each(*(writes if state == "finished" else reversed(writes)))  # a kill may come soon

    def _draw_summary(self, record: Record, optimizer: FIDE, image: Float32 | None) -> None:
        target, first, best = (
            None if one is None else picture(optimizer, one)
            for one in (optimizer.evaluator.full.target, record.first_image, image)
        )
        self.write_summary(
            record, target, first, best, counts=counting(optimizer.weights, optimizer.target)
        )


def best_pictures(record: Record, optimizer: FIDE) -> tuple[Float32 | None, Float32 | None]:
    """The best image as one picture: in [0, 1], and in the user's values where these are others."""
    best = None if record.image is None else best_compared(optimizer)
    shown = None if best is None else picture(optimizer, best)
    return shown, _in_user_values(optimizer, best)


def write_later(
    optimizer: FIDE,
    record: Record | None,
    plan: Mapping[str, Any],
    stopped: str,
    solutions: Sequence[Solution],
    lines: Sequence[str],
    path: str | os.PathLike[str],
) -> None:
    """Write a fit without a run directory into one; FideError if that cannot be done, OSError.

    record: None where it has stopped in the midst of a step.  plan: arguments of `SavedRun`; lines:
        those of `Result.plan`.
    """
    if record is None:
        raise OptionError("the fit was stopped in the midst of a step, and cannot be saved")
    if optimizer.evaluations != record.evaluations:
        raise OptionError(
            f"the optimizer has gone on since: {optimizer.evaluations} evaluations, and the "
            f"result is of {record.evaluations}; write optimizer.save(path) instead"
        )
    with closing(SavedRun(path, **plan, resume=False, command=None)) as saved:
        saved.begin(optimizer)
        saved.save(record, optimizer, *best_pictures(record, optimizer))
        state = stopped if stopped in ("interrupted", "failed") else "finished"
        saved.leave(state, stopped, record, optimizer, solutions, lines)


def settings_of(name: str, optimizer: FIDE, options: Mapping[str, Any]) -> dict[str, Any]:
    """What defines a fit, which must be the same to resume it.

    options: of the optimizer, as the user gave them; arrays are recorded by their digest.
    """
    target, several = optimizer.evaluator.full.target, isinstance(optimizer.target, list)
    space = optimizer.space
    made = {
        "x0": None if optimizer.guess is None else optimizer.guess.tolist(),
        "sigma0": np.asarray(optimizer.sigma0).tolist(),
        "groups": optimizer.options.groups,
    }
    return {
        "task": name,
        "task_seed": None,
        "task_options": {},
        "size": list(target.shape[:2]),
        "views": [list(one.shape[:2]) for one in optimizer.target] if several else None,
        "dim": optimizer.dim,
        "value_range": None if optimizer.value_range is None else list(optimizer.value_range),
        "target": _digest(target),
        "features": _features_of(optimizer) if callable(options.get("encoder")) else None,
        "space": None if space is None else space.to_dict(),
        "optimizer": "fide",
        "options": {
            key: _recorded(made.get(key, value))
            for key, value in options.items()
            if key not in ("loss", "learned", *_CONTENTS)
        },
        "weights": _recorded(optimizer.weights),
        "loss": optimizer.evaluator.loss.name,
        "seed": optimizer.seed,
    }


def _features_of(optimizer: FIDE) -> list[str]:
    """By which an encoder of the user's own is known again: its features of the target."""
    tokens = optimizer.target_tokens.double().cpu().numpy()
    return [f"{value:.2g}" for value in (tokens.mean(), tokens.std(), tokens.min(), tokens.max())]


def seed_there(out: str | os.PathLike[str]) -> int | None:
    """Seed of the run in the folder `out`; None if there is none.  Raises RunDirectoryError."""
    run = read_run(Path(out))
    seed = None if run is None else run["settings"].get("seed")
    return seed if isinstance(seed, int) else None


def _in_user_values(optimizer: FIDE, image: Float32 | None) -> Float32 | None:
    """One picture of an image with the user's values; None without one, or where it has [0, 1]."""
    if image is None or optimizer.value_range is None:
        return None
    return side_by_side(shown(optimizer, image))


def _recorded(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(key): _recorded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_recorded(one) for one in value]
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "__array__"):
        return _digest(np.asarray(value))
    return own_name(value)


def _digest(array: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def load_run(
    directory: str | os.PathLike[str], encoder: Callable[..., object] | None = None
) -> Result:
    """Result of the run of FIDE in a directory that `fit`, `fide fit` or `fide run` wrote.

    It may be finished, interrupted or under way: the newest checkpoint counts.  Nothing in the
    directory is executed, so it may be anybody's.  encoder: the user's own, if it has one.

    Raises OptionError for a directory without a run, for another optimizer, and where the encoder
    must be given; RunDirectoryError (a FileExistsError) if its record is damaged or no checkpoint
    is there, as of runs of a comparison; CheckpointError for a damaged checkpoint; OSError.
    """
    path, run, optimizer = opened(directory, encoder)
    settings, totals = run["settings"], run.get("totals")
    with impossible(path / "run.json", RunDirectoryError):
        record, _ = read_record(path, int(settings["dim"]), settings["size"])
        solutions = with_std(optimizer.solutions(), run)
        state = "running" if run["state"] == "running" else run.get("stopped", run["state"])
        known = totals if isinstance(totals, dict) else {}
        params, plan = known.get("params"), tuple(map(str, known.get("plan", ())))
    best = optimizer.best
    if best is not None:
        params = best.params or params or best.x.copy()  # a task has a space that FIDE lacks
    return result_from(
        optimizer,
        record,
        solutions,
        params=params,
        failures=record.failures,
        first_failure=None,
        busy=math.nan,
        stopped=str(state),
        out=path,
        plan=plan,
    )
