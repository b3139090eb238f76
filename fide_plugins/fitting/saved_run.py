"""The run directory of a fit: that of any other run, see `experiments.run.directory`.

What defines the run is recorded as its settings, and must be the same to resume it; the rules by
which it stops are its limits.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fide_plugins.experiments.run.directory import RunDirectory, read_run
from fide_plugins.experiments.run.judge import Verdict
from fide_plugins.experiments.run.outcome import result_of
from fide_plugins.experiments.run.record import Record
from fide_plugins.experiments.run.task import name_of
from fide_plugins.fide import FIDE
from fide_plugins.fitting.pictures import picture

__all__ = ["SavedRun", "seed_there", "settings_of"]


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
        *,
        resume: bool,
        command: Sequence[str] | None,
    ) -> None:
        words = None if command is None else list(command)
        self._directory = RunDirectory(out, settings, resume=resume, command=words, limits=limits)
        self.path = self._directory.path
        self._budget: int | None = limits.get("budget")

    def restore(self, loss: object) -> tuple[Record, FIDE] | None:
        """State that was saved; None without.  Raises CheckpointError (a ValueError)."""
        own = loss if callable(loss) else None
        restored: Any = self._directory.restore(loss=own)
        return restored  # type: ignore[no-any-return]

    def begin(self, optimizer: FIDE) -> None:
        """Write what is known before the first render."""
        self._directory.write_target(picture(optimizer, optimizer.evaluator.target))
        self._directory.write_run()

    def save(self, record: Record, optimizer: FIDE) -> None:
        """Write a checkpoint, the tables and the best image."""
        self._directory.save(record, optimizer)
        self._directory.write_curve(record)
        self._directory.write_improvements(record)
        if record.image is not None:
            self._directory.write_best(picture(optimizer, record.image))

    def leave(self, status: str, record: Record, optimizer: FIDE) -> None:
        """Write totals; status: "finished", "interrupted" or "failed"."""
        target = optimizer.evaluator.target
        result = result_of(
            self._directory.settings,
            record,
            _verdict(record, optimizer),
            budget=self._budget or record.evaluations,
            status=str(optimizer.status),
        )
        if status == "finished" and not isinstance(optimizer.target, list):
            self._directory.write_summary(result, target)
        self._directory.write_run(status, result)


def settings_of(name: str, optimizer: FIDE, options: Mapping[str, Any]) -> dict[str, Any]:
    """What defines a fit.

    name: of what renders; options: of the optimizer, as the user gave them.  Arrays are recorded by
    their digest.
    """
    target = optimizer.evaluator.target
    space = optimizer.space
    return {
        "task": name,
        "task_seed": None,
        "task_options": {},
        "size": list(target.shape[:2]),
        "dim": optimizer.dim,
        "target": _digest(target),
        "space": None if space is None else space.to_dict(),
        "optimizer": "fide",
        "options": {key: _recorded(value) for key, value in options.items() if key != "loss"},
        "loss": optimizer.evaluator.loss.name,
        "seed": optimizer.seed,
    }


def seed_there(out: str | os.PathLike[str]) -> int | None:
    """Seed of the run in the folder `out`; None if there is none.  Raises RunDirectoryError."""
    from pathlib import Path

    run = read_run(Path(out))
    seed = None if run is None else run["settings"].get("seed")
    return seed if isinstance(seed, int) else None


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
    return name_of(value)


def _digest(array: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
