"""Reads a comparison back from its directory."""

from __future__ import annotations

import csv
import os
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fide_lab.compare.directory import ERROR, digest, examine, read_record, runs_of
from fide_lab.compare.plan import Configuration, RunKey
from fide_plugins.errors import FideError, UnknownNameError
from fide_plugins.recording.storage import RunDirectoryError, read_run
from fide_plugins.runtime.files import read_regular
from fide_plugins.types import Float64

AXES = ("renders", "seconds")
"""Horizontal axes of a convergence curve."""


class NoResultsError(FideError, FileNotFoundError):
    """A folder holds no comparison, or nothing of it that can be reported."""


class AllFailedError(NoResultsError):
    """Nothing can be reported because runs failed."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Best loss so far of one run, as a step function with m steps.

    at: position of the steps along each of `AXES`, (m,).
    ends: end of the run along each of `AXES`.
    loss: (m,), of each improvement, so decreasing.
    metrics: other losses of the same images by name, (m,).
    """

    at: dict[str, Float64]
    ends: dict[str, float]
    loss: Float64
    metrics: dict[str, Float64]

    def value(self, axis: str, x: npt.ArrayLike, metric: str | None = None) -> Float64:
        """Value at each of `x`: NaN before the first step, the last value after the end."""
        values = self.loss if metric is None else self.metrics[metric]
        index = np.searchsorted(self.at[axis], x, side="right") - 1
        return np.append(values, np.nan)[index]  # index -1 gives NaN

    def loss_at(self, axis: str, x: float, metric: str | None = None) -> float:
        """Best loss at x, or a metric of that candidate; infinity before the first finite one."""
        value = float(self.value(axis, [x], metric)[0])
        return np.inf if np.isnan(value) else value

    def reaches(self, axis: str, loss: float, metric: str | None = None) -> float:
        """Position of the first value that is at most `loss`; infinity if there is none.

        Of a metric: position from which on it is, to the end.
        """
        below = (self.loss if metric is None else self.metrics[metric]) <= loss
        if metric is not None:
            below = np.logical_and.accumulate(below[::-1])[::-1]
        hits = np.flatnonzero(below)
        return float(self.at[axis][hits[0]]) if len(hits) else np.inf


@dataclass(frozen=True, eq=False)
class StoredRun:
    """One run of a comparison as its directory holds it.

    key: which run; folder: its run directory.
    state: "finished", "failed", "unfinished", "missing" or "damaged"; why: what went wrong.
    run: contents of `run.json`.
    curve: None unless the run is finished.
    """

    key: RunKey
    folder: Path
    state: Literal["finished", "failed", "unfinished", "missing", "damaged"]
    why: str = ""
    run: dict[str, Any] = field(default_factory=dict)
    curve: Curve | None = None

    @property
    def totals(self) -> dict[str, Any]:
        """Totals of a finished run."""
        totals: dict[str, Any] = self.run["totals"]
        return totals

    @property
    def final(self) -> float:
        """Noise-free loss of the best candidate; infinity if no loss was finite."""
        loss = self.totals["reference_loss"]
        return np.inf if loss is None else float(loss)


@dataclass(frozen=True, eq=False)
class Results:
    """All runs of a comparison, in the order of its plan, and its record.

    path: folder of the comparison.
    settings: what all runs share: image size, budget, targets, options, metrics.
    calls: each call of the command: command line, time, versions, machine.
    versions, machine: those of the last call.
    runs: one entry for each task, loss, configuration and seed that was planned.
    not_shown: labels of the configurations that `of` has left out.
    """

    path: Path
    settings: dict[str, Any]
    calls: list[dict[str, Any]]
    versions: dict[str, str]
    machine: dict[str, Any]
    runs: list[StoredRun]
    not_shown: tuple[str, ...] = ()

    def check(self) -> None:
        """Raise AllFailedError if runs failed and none is finished."""
        failed = sum(run.state == "failed" for run in self.runs)
        if failed and not any(run.state == "finished" for run in self.runs):
            raise AllFailedError(
                f"no run in {self.path} is finished, and {failed} of {len(self.runs)} "
                f"failed; {ERROR} in their directories has the tracebacks"
            )

    @property
    def optimizers(self) -> list[str]:
        """Labels of the configurations, in the order of the plan."""
        return list(dict.fromkeys(run.key.configuration for run in self.runs))

    def of(self, optimizers: Iterable[str]) -> Results:
        """The same comparison with the runs of these optimizers only, in the order of the plan.

        Raises UnknownNameError, or another OptionError (both ValueErrors), for one that it has not.
        """
        wanted = [Configuration.parse(text).label for text in optimizers]
        for label in wanted:
            if label not in self.optimizers:
                raise UnknownNameError.of(f"optimizer of {self.path}", label, self.optimizers)
        runs = [run for run in self.runs if run.key.configuration in wanted]
        rest = tuple(label for label in self.optimizers if label not in wanted)
        return replace(self, runs=runs, not_shown=(*self.not_shown, *rest))


def read(path: str | os.PathLike[str]) -> Results:
    """Read the comparison in the folder `path`.

    Raises NoResultsError (a FileNotFoundError) if there is none, RunDirectoryError (a
    FileExistsError) if its record is damaged.
    """
    folder = Path(path)
    record = read_record(folder)
    if record is None and read_run(folder) is not None:
        quoted = shlex.quote(str(folder))
        raise NoResultsError(
            f"{folder} holds a single run, and a report is of a comparison; look at the run by: "
            f"fide watch {quoted} or: fide solutions {quoted}"
        )
    if record is None:
        raise NoResultsError(f"{folder} holds no comparison; make one: fide compare ... --out DIR")
    runs = [_read_run(folder, key, identity) for key, identity in runs_of(record)]
    versions, here = record.get("versions", {}), record.get("machine", {})
    return Results(folder, record["settings"], record["calls"], versions, here, runs)


def _read_run(out: Path, key: RunKey, identity: str) -> StoredRun:
    folder = out / key.folder
    error = folder / ERROR
    try:
        run = read_run(folder) or {}
        state = examine(folder, run.get("settings", {}))
        if state.kind == "finished":
            if digest(run["settings"]) != identity:
                raise ValueError(f"it holds a run with other settings: {run['settings']}")
            return StoredRun(key, folder, "finished", "", run, _curve(folder, run))
        if error.exists():
            text = read_regular(error).decode("utf-8", "replace")
            return StoredRun(key, folder, "failed", text, run)
    except (RunDirectoryError, OSError, ValueError, KeyError, TypeError, AttributeError) as problem:
        return StoredRun(key, folder, "damaged", str(problem) or repr(problem))
    if state.kind == "damaged":
        return StoredRun(key, folder, "damaged", state.why)
    return StoredRun(key, folder, "unfinished" if state.kind == "started" else "missing")


def _curve(folder: Path, run: dict[str, Any]) -> Curve:
    names, *rows = csv.reader(read_regular(folder / "improvements.csv").decode().splitlines())
    table = np.array(rows, np.float64).reshape(len(rows), len(names)).T
    columns = dict(zip(names, table, strict=True))
    totals = run["totals"]
    at = {"renders": columns.pop("evaluation") + 1, "seconds": columns.pop("seconds")}
    ends = {"renders": float(totals["evaluations"]), "seconds": float(totals["wall_s"])}
    return Curve(at, ends, columns.pop("loss"), columns)
