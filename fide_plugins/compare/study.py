"""The directory of a comparison.

    study.json   settings; cells, each with the digest of its run's settings; calls of the command,
                 with versions and machine
    targets/TASK.png
    cells/TASK/LOSS/OPTIMIZER/seed-N/   the run directory of each cell

Tasks, losses, optimizers and seeds may be added later; what makes runs comparable may not change:
the size of the images, the budget, the targets, options, and what is measured.
"""

from __future__ import annotations

import hashlib
import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fide_plugins import files
from fide_plugins.compare.arms import as_file_name
from fide_plugins.compare.cell import State, examine
from fide_plugins.compare.plan import Cell, Checked, Plan
from fide_plugins.harness import machine
from fide_plugins.harness.directory import FORMAT, RunDirectoryError, check_settings
from fide_plugins.harness.figures import as_png

__all__ = ["Study", "cells_of", "digest", "read_study", "target_file"]


class Study:
    """The directory `path` of a comparison, made or reopened for `plan`.

    checked: what `Plan.check` found.
    resume: whether a comparison that is there may be continued.

    Raises RunDirectoryError (a FileExistsError) for a directory that holds something else, or the
    same with other settings; OSError if it cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        plan: Plan,
        checked: Checked,
        *,
        resume: bool,
    ) -> None:
        self.path, self._targets = Path(path), checked.targets
        settings = checked.settings
        self._settings = _comparable(plan, settings)
        self._cells = {cell: digest(run) for cell, run in settings.items()}
        self._call: dict[str, Any] | None = None
        before = read_study(self.path)
        if before is None:
            _check_empty(self.path)
        else:
            self._check(before["settings"], resume)
        self.states: dict[Cell, State] = {
            cell: examine(self.path / cell.folder, settings[cell]) for cell in settings
        }
        files.check_writable(self.path)
        files.remove_leftovers(self.path)

    def _check(self, theirs: dict[str, Any], resume: bool) -> None:
        mine = self._settings
        shared = set(theirs["targets"]) & set(mine["targets"])
        there, here = (
            {**{k: v for k, v in settings.items() if k != "targets"},
             **{f"the target of {task}": settings["targets"][task] for task in sorted(shared)}}
            for settings in (theirs, mine)
        )  # fmt: skip
        check_settings(there, here, f"{self.path} holds a comparison")
        if not resume:
            raise RunDirectoryError(
                f"{self.path} already holds a comparison with these settings; continue or extend "
                "it (--resume), or name another directory"
            )

    def begin(self, command: list[str], beside: dict[str, Any]) -> None:
        """Record a call of the command; beside: what runs at the same time.

        Raises RunDirectoryError (a FileExistsError) if somebody has begun another comparison here
        since it was checked.
        """
        self._write({"command": command, "started": _now(), "finished": None, **beside})
        (self.path / "targets").mkdir(exist_ok=True)
        for task, target in self._targets.items():
            files.write_bytes(target_file(self.path, task), as_png(target))

    def end(self) -> None:
        """Record that the last call has come to its end, or was stopped."""
        if self._call is not None:
            self._write({**self._call, "finished": _now()})

    def _write(self, call: dict[str, Any]) -> None:
        """Write `study.json` with this call, and with what others have written there meanwhile."""
        with files.locked(self.path / ".lock", wait=True):
            there = read_study(self.path)
            if there is not None:
                self._check(there["settings"], resume=True)
            study = self._joined(there, call)
            files.write_text(self.path / "study.json", json.dumps(study, indent=1) + "\n")
        self._call = call

    def _joined(self, there: dict[str, Any] | None, call: dict[str, Any]) -> dict[str, Any]:
        """The study `there`, with the cells of this one, and `call` in the place of its last."""
        there = there or {"format": FORMAT, "settings": {"targets": {}}, "cells": [], "calls": []}
        calls = [one for one in there["calls"] if one != self._call]
        cells = dict(cells_of(there)) | self._cells
        targets = {**there["settings"]["targets"], **self._settings["targets"]}
        return {
            **there,
            "settings": {**self._settings, "targets": targets},
            "cells": [[*cell, identity] for cell, identity in cells.items()],
            "calls": [*calls, call],
            "versions": machine.versions(),
            "machine": machine.machine(),
        }


def target_file(path: Path, task: str) -> Path:
    """Where the target of a task lies in the folder of a comparison."""
    return path / "targets" / f"{as_file_name(task)}.png"


def read_study(path: Path) -> dict[str, Any] | None:
    """Contents of `study.json` in the folder `path`; None if there is none.

    Raises RunDirectoryError (a FileExistsError) if it is damaged or of another version.
    """
    path = path / "study.json"
    if not path.exists():
        return None
    try:
        study: dict[str, Any] = json.loads(path.read_text("utf-8"))
        if study["format"] != FORMAT:
            raise ValueError(f"format {study['format']!r}, and this version reads {FORMAT}")
        _check_contents(study)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RunDirectoryError(
            f"{path} is not the record of a comparison of this version ({error}); "
            "name another directory"
        ) from error
    return study


def cells_of(study: dict[str, Any]) -> list[tuple[Cell, str]]:
    """Cells of a study, each with the digest of its settings."""
    return [(Cell(*entry[:4]), entry[4]) for entry in study["cells"]]


def digest(settings: dict[str, Any]) -> str:
    """What tells the settings of one run from those of others."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def _check_contents(study: dict[str, Any]) -> None:
    """Raise a ValueError, KeyError or TypeError unless it is what `Study` writes."""
    if not isinstance(study["settings"]["targets"], dict) or not isinstance(study["calls"], list):
        raise ValueError("no settings, or no calls")
    for entry in study["cells"]:
        task, loss, arm, seed, identity = entry
        texts = task, loss, arm, identity
        if not all(isinstance(text, str) for text in texts) or type(seed) is not int:
            raise ValueError(f"{entry!r} is no cell")


def _comparable(plan: Plan, settings: dict[Cell, dict[str, Any]]) -> dict[str, Any]:
    """What all runs of a comparison have in common."""
    task_options: dict[str, Any] = {}
    for run in settings.values():
        task_options |= run["task_options"]
    common = {
        "size": plan.size,
        "budget": plan.budget,
        "task_seed": plan.task_seed,
        "task_options": task_options,
        "options": plan.options,
        "metrics": list(plan.metrics),
        "targets": {cell.task: run["target"] for cell, run in settings.items()},
    }
    result: dict[str, Any] = json.loads(json.dumps(common))  # as it is read back
    return result


def _check_empty(path: Path) -> None:
    if path.is_dir() and any(not entry.name.startswith(".") for entry in path.iterdir()):
        raise RunDirectoryError(
            f"{path} holds something that is no comparison; name an empty or a new directory"
        )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
