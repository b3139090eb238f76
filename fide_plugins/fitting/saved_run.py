"""The run directory of a fit: that of any other run, see `recording.directory`.

What defines the run is recorded as its settings, and must be the same to resume it; the rules by
which it stops are its limits.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.pictures import counting, picture, shown, side_by_side
from fide_plugins.options import GLOBAL
from fide_plugins.recording import kept_solutions
from fide_plugins.recording.checkpointing import try_each
from fide_plugins.recording.directory import RunDirectory
from fide_plugins.recording.json_record import RunDirectoryError, read_run
from fide_plugins.recording.outcome import Verdict, result_of
from fide_plugins.recording.record import Record, RunResult
from fide_plugins.recording.run_checkpoint import is_saved
from fide_plugins.runtime.registry import own_name
from fide_plugins.types import Float32, Solution

__all__ = ["SavedRun", "Unsaved", "features_of", "seed_there", "settings_of"]

_RELATIVE, _ABSOLUTE = 1e-3, 1e-6  # by which losses and features may differ between machines
_CONTENTS = ("mask", "weights", "value_range")
"""Options that are recorded by what they are, not as they are given."""


class SavedRun:
    """What a fit writes, and what it reads when it is resumed.

    Raises RunDirectoryError (a FileExistsError) for a directory of another run, OSError if it
    cannot be written.
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        settings: dict[str, Any],
        limits: dict[str, Any],
        facts: dict[str, Any] | None = None,
        *,
        resume: bool,
        command: Sequence[str] | None,
        sources: Mapping[str, str] | None = None,
    ) -> None:
        words = None if command is None else list(command)
        self._directory = RunDirectory(
            out, settings, resume=resume, command=words, limits=limits, facts=facts, sources=sources
        )
        self.path = self._directory.path
        self._budget: int | None = limits.get("budget")

    def begin(self, optimizer: FIDE) -> Record | None:
        """As `restore`, and write what is known before the first render."""
        with ExitStack() as refused:
            refused.callback(self.close)
            record = self.restore(optimizer)
            target = optimizer.evaluator.target
            self._directory.write_target(picture(optimizer, target), _values(optimizer, target))
            self._directory.begin(None)
            refused.pop_all()
        return record

    def restore(self, optimizer: FIDE) -> Record | None:
        """Put the optimizer into the state that was saved; None without one.

        Raises CheckpointError (a ValueError); RunDirectoryError (a FileExistsError) if a loss or an
        encoder of the user's own gives other values than it did, as far as that shows: that of the
        best image, and of the target.
        """
        there = self._directory.facts.get("features", [])
        if there and not np.allclose(there, features_of(optimizer), rtol=_RELATIVE, atol=_ABSOLUTE):
            raise RunDirectoryError(
                f"{self.path} holds a run with another encoder: its features of the target differ; "
                "give the same one, or name another directory"
            )
        restored = self._directory.restore(optimizer.continue_from)
        if restored is None:
            return None
        record, _ = restored
        self._check_loss(optimizer)
        return record

    def _check_loss(self, optimizer: FIDE) -> None:
        best = optimizer.state.best
        image = None if best is None else best.solution.image
        if best is None or image is None or optimizer.evaluator.loss_name is not None:
            return
        there, here = best.solution.loss, float(optimizer.evaluator.loss.compute(image[None])[0])
        if not np.isclose(here, there, rtol=_RELATIVE, atol=_ABSOLUTE):
            raise RunDirectoryError(
                f"{self.path} holds a run with another loss: it was {there:.6g} for the best "
                f"image, and is {here:.6g} now; give the same one, or name another directory"
            )

    def close(self) -> None:
        """Let other processes go on with the run; nothing is to be written after this."""
        self._directory.close()

    def save(self, record: Record, optimizer: FIDE) -> None:
        """Write a checkpoint, the tables and the best image, each also where another fails.

        The checkpoint, the largest, comes last; but the first one first, so that a kill leaves no
        tables without one.
        """
        writes: list[Callable[[], object]] = [
            lambda: self.write_tables(record, optimizer),
            lambda: self._directory.save(record, optimizer),
        ]
        try_each(*(writes if is_saved(self.path) else reversed(writes)))

    def write_tables(self, record: Record, optimizer: FIDE) -> None:
        """Write the tables and the best image."""
        best = None if record.image is None else picture(optimizer, record.image)
        self._directory.write_tables(record, best, _values(optimizer, record.image))

    def leave(
        self,
        state: str,
        stopped: str,
        record: Record,
        optimizer: FIDE,
        solutions: Sequence[Solution],
    ) -> None:
        """Write totals and the summary.

        state: see `RunDirectory.write_run`.  stopped, solutions: see `Result`.
        """
        result = result_of(
            self._directory.settings,
            record,
            _verdict(record, optimizer),
            budget=self._budget or record.evaluations,
            status=optimizer.status,
        )
        more = {
            "failures": record.failures,
            "clipped": optimizer.clipped,
            "solutions": kept_solutions.written(solutions),
        }
        writes = [
            lambda: self._write_summary(result, optimizer),
            lambda: self._directory.write_run(state, result, stopped, more),
        ]
        if not record.evaluations:
            del writes[0]
        try_each(*(writes if state == "finished" else reversed(writes)))  # a kill may come soon

    def _write_summary(self, result: RunResult, optimizer: FIDE) -> None:
        """Write the summary, with views side by side."""
        first, best = (
            None if image is None else picture(optimizer, image)
            for image in (result.first_image, result.image)
        )
        shown = replace(result, first_image=first, image=best, reference=best)
        target = picture(optimizer, optimizer.evaluator.target)
        self._directory.write_summary(shown, target, counting(optimizer.weights, optimizer.target))


@dataclass(frozen=True, eq=False)
class Unsaved:
    """A fit without a run directory, which can still be written to one.

    record: None where it has stopped in the midst of a step of the optimizer.
    plan: arguments of `SavedRun`.  stopped, solutions: see `Result`.
    """

    optimizer: FIDE
    record: Record | None
    plan: Mapping[str, Any]
    stopped: str
    solutions: Sequence[Solution]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the run directory `path`.  Raises FideError if that cannot be done; OSError."""
        record, optimizer = self.record, self.optimizer
        if record is None:
            raise OptionError("the fit was stopped in the midst of a step, and cannot be saved")
        if optimizer.evaluations != record.evaluations:
            raise OptionError(
                f"the optimizer has gone on since: {optimizer.evaluations} evaluations, and the "
                f"result is of {record.evaluations}; write optimizer.save(path) instead"
            )
        saved = SavedRun(path, **self.plan, resume=False, command=None)
        with closing(saved):
            saved.begin(optimizer)
            saved.save(record, optimizer)
            ended = self.stopped not in ("interrupted", "failed")
            state = "finished" if ended else self.stopped
            saved.leave(state, self.stopped, record, optimizer, self.solutions)


def settings_of(
    name: str, optimizer: FIDE, options: Mapping[str, Any], budget: int | None
) -> dict[str, Any]:
    """What defines a fit.

    name: of what renders; options: of the optimizer, as the user gave them.  Arrays are recorded by
    their digest, mask and weights by that of their product; a starting point, its width and groups
    as the optimizer has made them, in whatever form they were given.  The budget is a limit, which
    may change, unless rounds of learning divide it.
    """
    target = optimizer.evaluator.target
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
        "dim": optimizer.dim,
        "value_range": None if optimizer.value_range is None else list(optimizer.value_range),
        "target": _digest(target),
        "space": None if space is None else space.to_dict(),
        "optimizer": "fide",
        "options": {
            key: _recorded(made.get(key, value))
            for key, value in options.items()
            if key not in ("loss", *_CONTENTS)
        },
        "weights": _recorded(optimizer.weights),
        "loss": optimizer.evaluator.loss.name,
        "seed": optimizer.seed,
        **({"budget": budget} if options.get("preset") == GLOBAL else {}),
    }


def features_of(optimizer: FIDE) -> list[float]:
    """Numbers by which an encoder of the user's own is known again: of its features of the target.

    Mean, standard deviation, least and largest.
    """
    tokens = optimizer.target_tokens.double().cpu().numpy()
    return [float(value) for value in (tokens.mean(), tokens.std(), tokens.min(), tokens.max())]


def seed_there(out: str | os.PathLike[str]) -> int | None:
    """Seed of the run in the folder `out`; None if there is none.  Raises RunDirectoryError."""
    from pathlib import Path

    run = read_run(Path(out))
    seed = None if run is None else run["settings"].get("seed")
    return seed if isinstance(seed, int) else None


def _values(optimizer: FIDE, image: Float32 | None) -> Float32 | None:
    """One picture of an image with the user's values; None without one, or where it has [0, 1]."""
    if image is None or optimizer.value_range is None:
        return None
    return side_by_side(shown(optimizer, image))


def _verdict(record: Record, optimizer: FIDE) -> Verdict:
    """The best image as the run has seen it: nobody knows a better one.

    Its squared error counts views and weights as the loss "mse" does.
    """
    image = record.image
    if image is None:
        return Verdict()
    return Verdict(image, record.best_loss, optimizer.views.squared_error(image))


def _recorded(value: Any) -> Any:
    """A value of an option as JSON has it."""
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
