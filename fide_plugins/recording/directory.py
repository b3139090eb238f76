"""The run directory, as a run writes it: each file atomically (docs/reference/files.md)."""

from __future__ import annotations

import csv
import io
import json
import os
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fide_plugins.errors import CheckpointError, DependencyError
from fide_plugins.recording.record import Record, best_so_far
from fide_plugins.recording.storage import (
    CHECKPOINT,
    FORMAT,
    TARGET_FILE,
    RunDirectoryError,
    check_settings,
    checksum,
    is_saved,
    now,
    read_record,
    read_run,
    write_checkpoint,
)
from fide_plugins.runtime import files, laboratory, machine
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import changed, kind_of

if TYPE_CHECKING:
    from fide_plugins.types import Float32, Optimizer

T = TypeVar("T")

TABLES = ("curve.csv", "improvements.csv")
_RESULTS = (*TABLES, "best.png", "best.tif", "reference.png", "summary.png", CHECKPOINT)
_WRITTEN = (
    *_RESULTS, TARGET_FILE, "run.json", "target.png", "target.tif",
    "optimizer-*.ckpt", "probe",  # `check_writable`
)  # fmt: skip
LOCK = ".run.lock"  # not that of a comparison, which holds its own meanwhile
_INTERVAL = 20  # least time between two checkpoints, in times of writing one


class CheckpointTimer:
    """Says when the next checkpoint is due; it counts from when it is made.

    every: seconds, at least twenty times the time to write one; 0: one is always due.
    """

    def __init__(self, every: float) -> None:
        self.every = every
        self._written_at, self._writing_took = perf_counter(), 0.0

    def due(self) -> bool:
        """Whether the last checkpoint is old enough, in seconds and in times of writing one."""
        if self.every <= 0:
            return True
        since = perf_counter() - self._written_at
        return since >= max(self.every, _INTERVAL * self._writing_took)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Around the writing of a checkpoint, which does not count where it raises."""
        start = perf_counter()
        yield
        self._written_at = perf_counter()
        self._writing_took = self._written_at - start


def note_unsaved(error: BaseException, unsaved: Exception) -> None:
    """Add to the error that ends a run, which matters more, that saving failed after it."""
    error.add_note(f"not everything could be written, perhaps no checkpoint: {unsaved}")


def try_each(*writes: Callable[[], object]) -> None:
    """Call all of them, also after one that fails (a full disk); then raise the first error."""
    first: Exception | None = None
    for write in writes:
        try:
            write()
        except Exception as error:
            if first is None:
                first = error
            elif str(error) != str(first):
                first.add_note(f"nor was this written: {error}")
    if first is not None:
        raise first


class RunDirectory:
    """Directory of one run, locked until `close`; made and checked before anything is rendered.

    settings: that define the run; a folder with other ones is refused, but for `may_change`.
    limits: when the run stops, where that is no setting.
    sources: fingerprints of the user's files, see `of_files`; warns of one that is edited.

    Raises RunDirectoryError (a FileExistsError), also if there are results without a `run.json`, or
    OSError if the folder cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        settings: dict[str, Any],
        *,
        resume: bool,
        command: Sequence[str] | None = None,
        limits: dict[str, Any] | None = None,
        may_change: Collection[str] = (),
        sources: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))  # as it is read back
        files.check_writable(self.path)
        if not (self.path / "run.json").exists() and (there := results_in(self.path)):
            raise RunDirectoryError(
                f"{self.path} has no run.json, but {', '.join(there)}, which a run may overwrite; "
                "name another directory, or move that away; if it was a run, copy its run.json "
                "back to go on with it"
            )
        with _lock(self.path) as lock:
            how = None if command is None else shlex.join(command)
            self._run: dict[str, Any] = {
                "format": FORMAT, "state": "running", "settings": self.settings, "command": how,
                "started": now(), "resumed": [],
            }  # fmt: skip
            before, begun = read_run(self.path), is_saved(self.path)
            if before is not None:
                self._check(before["settings"], resume, may_change)
                self._run = {**before, "settings": self.settings, "state": "running"}
                self._run["resumed"] = [*before.get("resumed", []), now()]
            if limits is not None:
                self._run["limits"] = limits
            if sources:
                self._run["sources"] = versions_with(sources, before, self.path, begun=begun)
            files.remove_leftovers(self.path, mine=is_of_a_run)  # not what others write there
            self._lock = lock.pop_all()

    @property
    def budget(self) -> int | None:
        """Renders after which it stops, where that is no setting."""
        budget: int | None = self._run["limits"].get("budget")
        return budget

    def close(self) -> None:
        """Let other processes work on the run; nothing is to be written after this."""
        self._lock.close()

    def restore(self, load: Callable[[Path], T]) -> tuple[Record, T] | None:
        """Record and optimizer, made by `load`, of the saved run; None without one.

        Raises CheckpointError where the state of results is missing.
        """
        if not is_saved(self.path):
            table = self.path / TABLES[0]
            if self._run["resumed"] and table.exists() and table.read_bytes().count(b"\n") > 1:
                if self._run.get("saved", True):
                    raise CheckpointError(
                        f"{self.path} holds results, but no {CHECKPOINT}, from which the run could "
                        "go on: copy it back, or start again in another directory"
                    )
                warn_user(
                    f"{self.path} holds results of a call that ended before its state could be "
                    "written: the run begins again, and replaces them"
                )
            return None
        record, file = read_record(self.path, self.settings["dim"], self.settings["size"])
        try:
            return record, load(file)
        except FileNotFoundError as error:
            if file.exists():  # it is another file that is missing
                raise
            raise CheckpointError(
                f"{file}: this file of the optimizer, which {CHECKPOINT} names, is missing; copy "
                "it back, or start again in another directory"
            ) from error

    def _check(self, there: dict[str, Any], resume: bool, may_change: Collection[str]) -> None:
        changed = {key: self.settings[key] for key in may_change}
        check_settings({**there, **changed}, self.settings, f"{self.path} holds a run")
        if not resume:
            how = "--resume" if self._run["command"] else "resume=True"
            raise RunDirectoryError(
                f"{self.path} already holds a run with these settings; resume it ({how}), "
                "or name another directory"
            )

    def save(
        self,
        record: Record,
        optimizer: Optimizer,
        best: Float32 | None,
        values: Float32 | None = None,
    ) -> None:
        """Write a checkpoint, the tables and the best image, each also where another fails.

        The checkpoint, the largest, comes last; but the first one first, so that a kill leaves no
        tables without one.  best, values: see `write_tables`.
        """

        def write_state() -> None:
            write_checkpoint(self.path, record, optimizer)
            if not self._run.get("saved"):
                self.write_run()

        writes = [lambda: self.write_tables(record, best, values), write_state]
        try_each(*(writes if is_saved(self.path) else reversed(writes)))

    def write_tables(
        self, record: Record, best: Float32 | None, values: Float32 | None = None
    ) -> None:
        """Write the tables and the best image, with its values where they are not in [0, 1]."""
        try_each(
            lambda: files.write_text(self.path / "curve.csv", curve_table(record)),
            lambda: files.write_text(self.path / "improvements.csv", improvements_table(record)),
            lambda: self.write_image("best", best, values),
        )

    def write_target(self, image: Float32, values: Float32 | None = None) -> None:
        """Write `target.png`, and `target.tif` of its values where these are others, once."""
        if not (self.path / "target.png").exists():
            self.write_image("target", image, values)

    def write_image(self, name: str, image: Float32 | None, values: Float32 | None = None) -> None:
        """Write a picture, and its values where they are not in [0, 1]."""
        from fide_plugins.validation.image_files import encoded

        for kind, pixels in ((".tif", values), (".png", image)):
            if pixels is not None:
                files.write_bytes(self.path / f"{name}{kind}", encoded(pixels, kind))

    def write_summary(self, record: Record, *pictures: Float32 | None, **more: Any) -> None:
        """Write `summary.png`; pictures, more: as for `fide_lab.figures.summary`.

        Without matplotlib, which is an extra, a warning says so: the run is worth more.
        """
        try:
            figures = laboratory.module("figures")
            picture = figures.summary(self.settings, record, *pictures, **more)
        except DependencyError as error:
            warn_user(f"summary.png is left out: {error}")
        else:
            files.write_bytes(self.path / "summary.png", picture)

    def write_run(
        self,
        state: str = "running",
        totals: Mapping[str, Any] | None = None,
        stopped: str | None = None,
    ) -> None:
        """Write `run.json`; stopped: the rule by which the run has ended."""
        self._run |= {
            "state": state,
            "saved": is_saved(self.path),  # so that one which is removed is missed
            "versions": machine.versions(),
            "machine": machine.machine(),
            "load": machine.load(),
            "written": now(),
        }
        self._run.pop("stopped", None)
        if stopped is not None:
            self._run["stopped"] = stopped
        if totals is not None:
            self._run["totals"] = dict(totals)
        if state == "finished":
            self._run["checksums"] = {name: checksum(self.path / name) for name in TABLES}
        files.write_text(self.path / "run.json", json.dumps(self._run, indent=2) + "\n")


def _lock(path: Path) -> ExitStack:
    with ExitStack() as lock:
        if not lock.enter_context(files.locked(path / LOCK)):
            raise RunDirectoryError(
                f"the run in {path} is under way, in another process or in this one; wait until it "
                "ends or stop it, and resume then, or name another directory"
            )
        return lock.pop_all()


def is_of_a_run(name: str) -> bool:
    """Whether a run writes files of that name."""
    return any(fnmatchcase(name, pattern) for pattern in _WRITTEN)


def results_in(path: Path) -> list[str]:
    """Names of files in the folder `path` that a run writes again: tables, pictures, state."""
    return [name for name in _RESULTS if (path / name).exists()]


def curve_table(record: Record) -> str:
    """`curve.csv`: one line for each evaluation."""
    losses, seconds = np.array(record.losses), np.array(record.seconds)
    rows = zip(losses.tolist(), best_so_far(losses).tolist(), seconds.tolist(), strict=True)
    lines = ["evaluation,loss,best_loss,seconds"]
    lines += [f"{i},{loss!r},{b!r},{s:.4f}" for i, (loss, b, s) in enumerate(rows)]
    return "\n".join(lines) + "\n"


def improvements_table(record: Record) -> str:
    """`improvements.csv`; what a metric that raised has not measured is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")  # names of losses may need quoting
    writer.writerow(["evaluation", "seconds", "loss", *record.metrics])
    for k, i in enumerate(record.improvements):
        others = (repr(v[k]) if k < len(v) else "" for v in record.metrics.values())
        writer.writerow([i, f"{record.seconds[i]:.4f}", repr(record.losses[i]), *others])
    return buffer.getvalue()


# What a run depends on by name: `run.json` has each version, so that another one is noticed.


def of_files(fingerprints: Mapping[str, str | None]) -> dict[str, str]:
    """Those fingerprints, by reference, that are of a file."""
    return {k: one for k, one in fingerprints.items() if one is not None and kind_of(one) == "file"}


def file_of(reference: str) -> str:
    """File or module of a reference such as "mine.py:Search"."""
    return reference.rpartition(":")[0] or reference


def versions_there(run: Mapping[str, Any] | None) -> dict[str, list[str]]:
    """Fingerprints in the contents of `run.json`, by reference, the newest last."""
    found = None if run is None else run.get("sources")
    return {
        reference: versions
        for reference, versions in (found.items() if isinstance(found, dict) else ())
        if isinstance(versions, list) and versions and all(isinstance(v, str) for v in versions)
    }


def edited(there: Mapping[str, list[str]], here: Mapping[str, str]) -> list[str]:
    """References to files of which a run has had another version than the present one."""
    return [
        reference
        for reference, now in here.items()
        if any(changed(before, now) for before in there.get(reference, []))
    ]


def versions_with(
    here: Mapping[str, str], before: Mapping[str, Any] | None, path: Path, *, begun: bool
) -> dict[str, list[str]]:
    """Fingerprints of a run that is begun, or resumed; warns of one that has changed since.

    before: its `run.json`; begun: whether it goes on from a state of the versions before.
    """
    there = versions_there(before) if begun else {}
    newest = {reference: versions[-1:] for reference, versions in there.items()}
    for reference in edited(newest, here):
        warn_user(
            f"{file_of(reference)} has changed since the run in {path} was last at work: what is "
            "there was made with the earlier version, and what follows is with this one; unless "
            "the change only mends an error, undo it, or start again in another directory"
        )
    new = {name: now for name, now in here.items() if newest.get(name) != [now]}
    return there | {name: [*there.get(name, []), now] for name, now in new.items()}
