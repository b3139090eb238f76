"""One cell: whether it is done, and doing it, whatever happens.

A cell's folder is a run directory.  It is finished when `run.json` says so and the tables have the
checksums it names; anything that cannot be read is cleared and done again.  A cell that fails
leaves its traceback in `error.txt`; the next call tries it once more.
"""

from __future__ import annotations

import shutil
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fide_plugins import files
from fide_plugins.compare.plan import Cell, Plan
from fide_plugins.errors import CheckpointError
from fide_plugins.harness import Interrupted, Progress, Run, prepare
from fide_plugins.harness.directory import (
    TABLES,
    RunDirectoryError,
    check_settings,
    checksum,
    read_run,
)
from fide_plugins.harness.record import PARTS

__all__ = ["ERROR", "Outcome", "State", "examine", "run_cell"]

ERROR = "error.txt"
_LOCK = ".lock"
_COUNTED = ("dim", "evaluations", "best_evaluation", "rounds", "wall_s")
_LOSSES = ("best_loss", "reference_loss", "recommended_loss")  # None where there is none

Watch = Callable[[Progress], None]


@dataclass(frozen=True)
class State:
    """What a cell's folder holds.

    kind: "finished"; "started", to be continued; "missing"; "damaged", to be done again.
    why: what is wrong with a damaged one.
    """

    kind: Literal["finished", "started", "missing", "damaged"]
    why: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a cell.

    kind: "done" now; "kept", since it was finished before; "failed"; "interrupted", and saved;
        "busy", since another process is at it.
    note: in words, what failed or what had to be done again.
    totals: of `run.json`, of one that is done.
    signum: the signal that interrupted it.
    """

    cell: Cell
    kind: Literal["done", "kept", "failed", "interrupted", "busy"]
    note: str = ""
    totals: dict[str, Any] | None = None
    signum: int = 0


def examine(folder: Path, settings: dict[str, Any]) -> State:
    """State of the cell in `folder`.

    Raises RunDirectoryError (a FileExistsError), naming the setting that differs, if it is there
    with other settings.
    """
    try:
        run = read_run(folder)
    except RunDirectoryError as error:
        return State("damaged", str(error))
    except OSError as error:
        return State("damaged", f"{folder}: {error}")
    if run is None:
        return State("missing")
    check_settings(run["settings"], settings, f"{folder} holds a run")
    if run.get("status") != "finished":
        return State("started")
    for name in TABLES:
        try:
            if checksum(folder / name) != run["checksums"][name]:
                return State("damaged", f"{folder / name} was changed or cut short")
        except (OSError, KeyError, TypeError) as error:
            return State("damaged", f"{folder / name} cannot be checked: {error!r}")
    wrong = _wrong_totals(run.get("totals"))
    if wrong:
        return State("damaged", f"{folder / 'run.json'} has no {wrong} that could be read")
    return State("finished")


def run_cell(
    plan: Plan,
    cell: Cell,
    settings: dict[str, Any],
    out: Path,
    command: list[str] | None = None,
    watch: Watch | None = None,
) -> Outcome:
    """Do what is left of a cell of the comparison in `out`; nothing it does raises.

    settings: by which its run is known, see `Plan.check`.  What does raise is a folder that cannot
    be written, or that holds a run with other settings.
    """
    folder = out / cell.folder
    folder.mkdir(parents=True, exist_ok=True)
    with files.locked(folder / _LOCK) as mine:
        if not mine:
            return Outcome(cell, "busy", "another process is at it")
        state = examine(folder, settings)
        if state.kind == "finished":
            return Outcome(cell, "kept", totals=_totals(folder))
        if state.kind == "damaged":
            _clear(folder)
        try:
            run, note = _prepare(plan, cell, folder, command)
            run.execute(watch)
        except Interrupted as stop:
            return Outcome(cell, "interrupted", str(stop), signum=stop.signum)
        except (Exception, SystemExit) as error:
            files.write_text(folder / ERROR, traceback.format_exc())
            return Outcome(cell, "failed", f"{type(error).__name__}: {error}")
        (folder / ERROR).unlink(missing_ok=True)
        note = f"it was damaged ({state.why}) and done again" if state.why else note
        return Outcome(cell, "done", note, _totals(folder))


def _prepare(plan: Plan, cell: Cell, folder: Path, command: list[str] | None) -> tuple[Run, str]:
    """The run of a cell, continued where that can be; else a new one, and why."""
    arm = plan.arm(cell.arm)

    def attempt() -> Run:
        return prepare(
            cell.task,
            arm.name,
            cell.loss,
            arm.budget or plan.budget,
            cell.seed,
            size=plan.size,
            task_seed=plan.task_seed,
            task_options=plan.task_options,
            options=plan.options_of(arm),
            out=folder,
            resume=True,
            command=command,
            keep=plan.keep,
        )

    try:
        return attempt(), ""
    except CheckpointError as error:
        _clear(folder)
        return attempt(), f"it could not be continued ({error}) and was done again"


def _wrong_totals(totals: Any) -> str:
    """Name of the first total of a finished run that is missing or nonsense; empty if none."""
    if not isinstance(totals, dict):
        return "totals"
    times, judged = totals.get("times"), totals.get("judged")
    numbers = {name: totals.get(name) for name in _COUNTED}
    numbers |= {name: totals.get(name, "") for name in _LOSSES if totals.get(name, "") is not None}
    if not isinstance(times, dict) or not isinstance(judged, dict):
        return "times or judgment"
    numbers |= {part: times.get(part) for part in PARTS}
    numbers |= {name: value for name, value in judged.items() if value is not None}
    wrong = [k for k, v in numbers.items() if isinstance(v, bool) or not isinstance(v, int | float)]
    return wrong[0] if wrong else "" if totals["evaluations"] >= 1 else "evaluations"


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


def _totals(folder: Path) -> dict[str, Any] | None:
    run = read_run(folder)
    return None if run is None else run.get("totals")
