"""The directory of a comparison, and the state of each of its runs.

    study.json   record: settings; "cells", one entry for each run, with the digest of its
                 settings; calls of the command, with versions and machine
    targets/TASK.png     and the same to the last bit, TASK.ckpt, which all runs read
    cells/TASK/LOSS/CONFIGURATION/seed-N/   run directory of each run

Tasks, losses, configurations and seeds may be added later.  Settings that make runs comparable
may not change: image size, budget, targets, options and metrics.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fide_lab.compare.plan import TARGETS, Checked, Plan, RunKey, target_file
from fide_lab.run.kept_target import write_target
from fide_plugins.recording.directory import TABLES, edited, file_of, results_in, versions_there
from fide_plugins.recording.storage import (
    FORMAT,
    RunDirectoryError,
    check_settings,
    checksum,
    now,
    read_json,
    read_run,
)
from fide_plugins.runtime import files, machine
from fide_plugins.validation.image_files import encoded

ERROR = "error.txt"
"""Traceback of a run that failed, in its directory; the next call tries it again."""
LOCK = ".lock"
_OLD = 3600.0  # seconds; nothing that is written here takes so long


@dataclass(frozen=True)
class State:
    """State of a run's directory.

    kind: "finished", as `run.json` says, and the tables have the checksums that it names;
        "started", to be continued; "missing"; "damaged" or "outdated", to be repeated; "busy",
        executed by another process.
    why: what is wrong with a damaged run, or which file has changed since an outdated one.
    """

    kind: Literal["finished", "started", "missing", "damaged", "outdated", "busy"]
    why: str = ""


def examine(
    folder: Path, settings: dict[str, Any], sources: Mapping[str, str] | None = None
) -> State:
    """State of the run in `folder`, whoever executes it.

    sources: see `plan.Checked.versions`; None: as those of the run.
    """
    try:
        run = read_run(folder)
    except (RunDirectoryError, OSError) as error:
        return State("damaged", f"{folder}: {error}")
    if run is None:
        left = results_in(folder)
        return State("damaged", f"{folder / left[0]} has no run.json") if left else State("missing")
    check_settings(run["settings"], settings, f"{folder} holds a run")
    if run.get("state") != "finished":
        changed = edited(versions_there(run), sources or {})
        if changed:
            return State("outdated", f"{file_of(changed[0])} has changed since it was begun")
        return State("started")
    for name in TABLES:
        try:
            if checksum(folder / name) != run["checksums"][name]:
                return State("damaged", f"{folder / name} was changed or cut short")
        except (OSError, KeyError, TypeError) as error:
            return State("damaged", f"{folder / name} cannot be checked: {error!r}")
    return State("finished")


class ComparisonDirectory:
    """Directory `path` of a comparison, made or reopened for `plan`.

    checked: result of `Plan.check`.
    resume: whether an existing comparison may be continued.

    Raises RunDirectoryError (a FileExistsError) for results of another version of a user's file,
    for a directory that holds something else, or a comparison with other settings; OSError if it
    cannot be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], plan: Plan, checked: Checked, *, resume: bool
    ) -> None:
        self.path, self._targets = Path(path), checked.targets
        self._settings = _comparable(plan, checked.settings)
        self._runs = {key: digest(run) for key, run in checked.settings.items()}
        self._call: dict[str, Any] | None = None
        before = read_record(self.path)
        if before is None:
            _check_empty(self.path)
        else:
            self._check(before["settings"])
            if not resume:
                raise RunDirectoryError(
                    f"{self.path} already holds a comparison with these settings; continue or "
                    "extend it (--resume), or name another directory"
                )
        self.states = {
            key: self._state(key, run, checked.versions) for key, run in checked.settings.items()
        }
        there = [] if before is None else [key for key, _ in runs_of(before)]
        _check_versions(self.path, checked.versions, there)
        files.check_writable(self.path)
        for folder in (self.path, self.path / TARGETS):
            files.remove_leftovers(folder, age=_OLD)  # another process may be at work here

    def _state(self, key: RunKey, run: dict[str, Any], versions: Mapping[str, str]) -> State:
        folder = self.path / key.folder
        state = examine(folder, run, versions)
        busy = state.kind != "finished" and files.is_locked(folder / LOCK)
        return State("busy") if busy else state

    def _check(self, theirs: dict[str, Any]) -> None:
        there, here = ({**one, "targets": None} for one in (theirs, self._settings))
        check_settings(there, here, f"{self.path} holds a comparison")
        for task, target in self._settings["targets"].items():
            kept = {"target": theirs["targets"].get(task, target)}
            check_settings(kept, {"target": target}, f"{self.path} holds a comparison on {task}")

    def begin(self, command: list[str], workers: dict[str, Any]) -> None:
        """Record a call of the command; workers: its processes and cores."""
        self._write({"command": command, "started": now(), "finished": None, **workers})
        for task, target in self._targets.items():
            files.write_bytes(target_file(self.path, task, "png"), encoded(target.image, ".png"))

    def end(self) -> None:
        """Record that the last call has ended or was stopped."""
        if self._call is not None:
            self._write({**self._call, "finished": now()})

    def _write(self, call: dict[str, Any]) -> None:
        """Write `study.json` with this call, and keep what other processes wrote meanwhile."""
        with files.locked(self.path / LOCK, wait=True):
            there = read_record(self.path)
            if there is None:
                there = {"format": FORMAT, "settings": {"targets": {}}, "cells": [], "calls": []}
            else:
                self._check(there["settings"])
            if self._call is None:  # before the record names them: nobody renders the same again
                (self.path / TARGETS).mkdir(exist_ok=True)
                for task, target in self._targets.items():
                    write_target(target_file(self.path, task), target)
            runs = dict(runs_of(there)) | self._runs
            targets = {**there["settings"]["targets"], **self._settings["targets"]}
            record = {
                **there,
                "settings": {**self._settings, "targets": targets},
                "cells": [[*key, identity] for key, identity in runs.items()],
                "calls": [*(one for one in there["calls"] if one != self._call), call],
                "versions": machine.versions(),
                "machine": machine.machine(),
            }
            files.write_text(self.path / "study.json", json.dumps(record, indent=1) + "\n")
        self._call = call


def read_record(path: Path) -> dict[str, Any] | None:
    """Contents of `study.json` in the folder `path`; None if there is none."""
    return read_json(path / "study.json", "comparison", _check_contents)


def runs_of(record: dict[str, Any]) -> list[tuple[RunKey, str]]:
    """Runs in the record of a comparison, each with the digest of its settings."""
    return [(RunKey(*entry[:4]), entry[4]) for entry in record["cells"]]


def digest(settings: dict[str, Any]) -> str:
    """Digest that identifies the settings of a run."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def _check_contents(record: dict[str, Any]) -> None:
    """Raise ValueError, KeyError or TypeError for contents `ComparisonDirectory` never writes."""
    if not isinstance(record["settings"]["targets"], dict) or not isinstance(record["calls"], list):
        raise ValueError("no settings, or no calls")
    for entry in record["cells"]:
        if [type(part) for part in entry] != [str, str, str, int, str]:
            raise ValueError(f"{entry!r} does not describe a run")


def _comparable(plan: Plan, settings: dict[RunKey, dict[str, Any]]) -> dict[str, Any]:
    task_options: dict[str, Any] = {}
    for run in settings.values():
        task_options |= run["task_options"]
    names = ("size", "budget", "task_seed", "options", "metrics")
    common = {name: getattr(plan, name) for name in names}
    targets = {key.task: run["target"] for key, run in settings.items()}
    text = json.dumps({**common, "task_options": task_options, "targets": targets})
    return dict(json.loads(text))  # as it is read back


def _check_empty(path: Path) -> None:
    """Raise RunDirectoryError for other files than a call leaves that ends before its record."""
    there = [entry for entry in path.glob("[!.]*") if entry.name != TARGETS]
    if there or any(one.suffix != ".ckpt" for one in (path / TARGETS).glob("[!.]*")):
        raise RunDirectoryError(
            f"{path} holds files that belong to no comparison; name an empty or a new directory"
        )


def _check_versions(path: Path, sources: Mapping[str, str], runs: Iterable[RunKey]) -> None:
    """Raise RunDirectoryError if a finished run is of another version of a source."""
    for key in runs:
        try:
            run = read_run(path / key.folder)
        except (RunDirectoryError, OSError):  # it will be repeated, or reported as damaged
            continue
        finished = run is not None and run.get("state") == "finished"
        for reference in edited(versions_there(run), sources) if finished else ():
            raise RunDirectoryError(
                f"{file_of(reference)} has changed since runs with {reference} in {path} were "
                "finished, with which others do not belong: undo the change, name another "
                f"directory, or delete {path / key.folder.parent} and the other runs with it"
            )
