"""One run of a comparison: the state of its directory, and its execution.

A run is finished when `run.json` says so and the tables have the checksums that it names.  A
damaged run is deleted and repeated, and so is one that was begun with another version of a file of
the user.  A run that fails leaves its traceback in `error.txt`; the next call tries it again.
"""

from __future__ import annotations

import shutil
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fide_lab.compare.plan import Plan, RunKey, target_file
from fide_lab.run import Interrupted, Run, prepare
from fide_lab.run.kept_target import read_target
from fide_plugins.errors import CheckpointError
from fide_plugins.recording.directory import TABLES, results_in
from fide_plugins.recording.sources import edited, file_of, versions_there
from fide_plugins.recording.storage import (
    RunDirectoryError,
    check_settings,
    checksum,
    read_run,
)
from fide_plugins.runtime import files
from fide_plugins.runtime.messages import said_once

__all__ = ["ERROR", "Outcome", "State", "examine", "is_busy", "run_one"]

ERROR = "error.txt"
_LOCK = ".lock"


@dataclass(frozen=True)
class State:
    """State of a run's directory.

    kind: "finished"; "started", to be continued; "missing"; "damaged" or "outdated", to be
        repeated; "busy", executed by another process.
    why: what is wrong with a damaged run, or which file has changed since an outdated one.
    """

    kind: Literal["finished", "started", "missing", "damaged", "outdated", "busy"]
    why: str = ""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    key: which run.
    kind: "done" now; "kept", finished before; "failed"; "interrupted", and saved; "busy", locked by
        another process.
    note: what failed, or why the run was repeated.
    totals: totals in `run.json` of a finished run.
    signum: the signal that interrupted the run.
    """

    key: RunKey
    kind: Literal["done", "kept", "failed", "interrupted", "busy"]
    note: str = ""
    totals: dict[str, Any] | None = None
    signum: int = 0


def is_busy(folder: Path) -> bool:
    """Whether another process executes the run in `folder`, as far as its lock tells."""
    return files.is_locked(folder / _LOCK) is True


def examine(
    folder: Path, settings: dict[str, Any], sources: Mapping[str, str] | None = None
) -> State:
    """State of the run in `folder`, whoever executes it.

    sources: fingerprints of the user's files now, see `Plan.sources`; None: as those of the run.
    """
    try:
        run = read_run(folder)
    except RunDirectoryError as error:
        return State("damaged", str(error))
    except OSError as error:
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


def run_one(
    plan: Plan,
    key: RunKey,
    settings: dict[str, Any],
    out: Path,
    command: list[str] | None = None,
    versions: Mapping[str, str] | None = None,
    said: frozenset[str] = frozenset(),
) -> Outcome:
    """Execute or continue one run of the comparison in `out`.

    settings, versions, said: settings that define the run, versions on which it depends beside the
        user's files, and warnings not to repeat, see `Plan.check`.

    A run that fails does not raise.  Raises OSError if the folder cannot be written, and
    RunDirectoryError (a FileExistsError) if it holds a run with other settings.
    """
    folder = out / key.folder
    folder.mkdir(parents=True, exist_ok=True)
    with files.locked(folder / _LOCK) as mine:
        if not mine:
            return Outcome(key, "busy", "another process executes it")
        state = examine(folder, settings, {**plan.sources(), **(versions or {})})
        if state.kind == "finished":
            return Outcome(key, "kept", totals=_totals(folder))
        if state.why:
            _clear(folder)
        # of an earlier attempt: from here on the run counts as unfinished, not as failed
        (folder / ERROR).unlink(missing_ok=True)
        try:
            with said_once(set(said)):
                run, note = _prepare(plan, key, out, command)
            run.execute()
        except Interrupted as stop:
            return Outcome(key, "interrupted", str(stop), signum=stop.signum)
        except (Exception, SystemExit) as error:
            files.write_text(folder / ERROR, traceback.format_exc())
            return Outcome(key, "failed", f"{type(error).__name__}: {error}")
        if state.why:
            damaged = "it was damaged: " if state.kind == "damaged" else ""
            note = f"repeated, because {damaged}{state.why}"
        return Outcome(key, "done", note, _totals(folder))


def _prepare(plan: Plan, key: RunKey, out: Path, command: list[str] | None) -> tuple[Run, str]:
    folder = out / key.folder
    configuration = plan.configuration(key.configuration)
    kept = read_target(target_file(out, key.task))
    target = None if kept is None else kept.image

    def attempt() -> Run:
        return prepare(
            key.task,
            configuration.name,
            key.loss,
            configuration.budget or plan.budget,
            key.seed,
            size=plan.size,
            task_seed=plan.task_seed,
            task_options=plan.task_options,
            options=plan.options_of(configuration),
            out=folder,
            resume=True,
            command=command,
            keep=plan.keep,
            target=target,
        )

    try:
        return attempt(), ""
    except CheckpointError as error:
        _clear(folder)
        return attempt(), f"repeated, because it could not be continued: {error}"


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


def _totals(folder: Path) -> dict[str, Any] | None:
    run = read_run(folder)
    return None if run is None else run.get("totals")
