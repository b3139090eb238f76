"""The run directory: what lies in it, and how it stays consistent.

    run.json       settings, versions, machine, seeds, command, totals, status, and at the end the
                   checksums of the two tables
    curve.csv      one line for each evaluation
    improvements.csv   one line for each that was the best so far; with other losses, where kept
    best.png       the best image so far
    frame-N.png    the best image after N renders, small, where a film is kept
    reference.png  of a noisy task, the image by which the best candidate was judged
    summary.png    target, first render, best, curve
    run.ckpt       the loop's state; it names the file of the optimizer that belongs to it
    optimizer-N-M.ckpt   after N evaluations, with M candidates pending

Each file is replaced atomically.  The optimizer's file is written first, under a new name, then
`run.ckpt`, which points to it, then the old one is removed: a kill at any moment leaves a pair that
belongs together.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import shlex
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins import checkpoint, files, optimizers
from fide_plugins.errors import CheckpointError, FideError
from fide_plugins.harness import machine
from fide_plugins.harness.parallel import WORKERS, rounds
from fide_plugins.harness.record import Record, RunResult
from fide_plugins.harness.record_form import check_record
from fide_plugins.state_form import IMPOSSIBLE

if TYPE_CHECKING:
    from fide_plugins.images import Float32
    from fide_plugins.protocols import Optimizer

__all__ = ["TABLES", "RunDirectory", "RunDirectoryError", "check_settings", "checksum", "read_run"]

FORMAT = 2
TABLES = ("curve.csv", "improvements.csv")
_KIND = "run"
_OPTIMIZER_FILE = re.compile(r"optimizer-[0-9]+-[0-9]+\.ckpt")


class RunDirectoryError(FideError, FileExistsError):
    """A run directory belongs to another run, or is none."""


class RunDirectory:
    """One run's folder; made, checked for its settings, and probed before anything is rendered.

    path: folder, made if need be.
    settings: what defines the run; a folder with others is refused.
    resume: whether a run that is there may be continued.
    command: command line, to be recorded.

    Raises RunDirectoryError (a FileExistsError), or OSError if the folder cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        settings: dict[str, Any],
        *,
        resume: bool,
        command: list[str] | None = None,
    ) -> None:
        self.path = Path(path)
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))  # as it is read back
        files.check_writable(self.path)
        self._run: dict[str, Any] = {
            "format": FORMAT,
            "status": "running",
            "settings": self.settings,
            "command": None if command is None else shlex.join(command),
            "started": _now(),
            "resumed": [],
        }
        before = read_run(self.path)
        if before is not None:
            self._check(before, resume)
            self._run = {**before, "status": "running"}
            self._run["resumed"] = [*before.get("resumed", []), _now()]
        files.remove_leftovers(self.path)

    # -- reading -----------------------------------------------------------------------------------

    def restore(self) -> tuple[Record, Optimizer] | None:
        """State of the run that was here; None if it never came to save one.

        Raises CheckpointError (a ValueError) if it is damaged.
        """
        path = self.path / "run.ckpt"
        if not path.exists():
            return None
        state = checkpoint.read(path, _KIND)
        try:
            name = state["optimizer"]
            if not _OPTIMIZER_FILE.fullmatch(name):
                raise ValueError(f"it names no optimizer's file of the run directory, {name!r}")
            check_record(state["record"], self.settings["dim"], self.settings["size"])
            record = Record.from_state(state["record"])
        except IMPOSSIBLE as error:
            raise CheckpointError(f"{path}: impossible contents ({error})") from error
        optimizer = optimizers.load(self.settings["optimizer"], self.path / name)
        if optimizer.dim != self.settings["dim"]:
            raise CheckpointError(f"{self.path / name}: an optimizer of {optimizer.dim} parameters")
        return record, optimizer

    def _check(self, before: dict[str, Any], resume: bool) -> None:
        check_settings(before["settings"], self.settings, f"{self.path} holds a run")
        if not resume:
            raise RunDirectoryError(
                f"{self.path} already holds a run with these settings; resume it (--resume), "
                "or name another directory"
            )

    # -- writing -----------------------------------------------------------------------------------

    def save(self, record: Record, optimizer: Optimizer) -> None:
        """Write the state from which the run can go on."""
        pending = 0 if record.pending is None else len(record.pending)
        name = f"optimizer-{record.evaluations}-{pending}.ckpt"  # one name for each state
        optimizer.save(self.path / name)
        state = {"record": record.state(), "optimizer": name}
        checkpoint.write(self.path / "run.ckpt", _KIND, state)
        for old in self.path.glob("optimizer-*.ckpt"):
            if old.name != name:
                with suppress(OSError):
                    old.unlink()

    def write_curve(self, record: Record) -> None:
        """Write `curve.csv`."""
        losses, seconds = np.array(record.losses), np.array(record.seconds)
        best = np.minimum.accumulate(np.where(np.isfinite(losses), losses, np.inf))
        rows = zip(losses.tolist(), best.tolist(), seconds.tolist(), strict=True)
        lines = ["evaluation,loss,best_loss,seconds"]
        lines += [f"{i},{loss!r},{b!r},{s:.4f}" for i, (loss, b, s) in enumerate(rows)]
        files.write_text(self.path / "curve.csv", "\n".join(lines) + "\n")

    def write_improvements(self, record: Record) -> None:
        """Write `improvements.csv`."""
        in_round = rounds(record.generations)
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")  # names of losses may hold anything
        names = ["evaluation", "seconds", f"round_of_{WORKERS}", "loss", *record.metrics]
        writer.writerow(names)
        for k, i in enumerate(record.improvements):
            others = (repr(values[k]) for values in record.metrics.values())
            where = [i, f"{record.seconds[i]:.4f}", in_round[i]]
            writer.writerow([*where, repr(record.losses[i]), *others])
        files.write_text(self.path / "improvements.csv", buffer.getvalue())

    def write_frame(self, mark: int, image: Float32) -> None:
        """Write `frame-N.png`, the best image after `mark` renders."""
        from fide_plugins.harness.figures import as_png, thumbnail

        files.write_bytes(self.path / f"frame-{mark}.png", as_png(thumbnail(image)))

    def write_best(self, image: Float32 | None) -> None:
        """Write `best.png`."""
        if image is not None:
            from fide_plugins.harness.figures import as_png

            files.write_bytes(self.path / "best.png", as_png(image))

    def write_reference(self, result: RunResult) -> None:
        """Write `reference.png` if it is another image than the best of the run."""
        from fide_plugins.harness.figures import as_png, noisy

        if result.reference is not None and noisy(result):
            files.write_bytes(self.path / "reference.png", as_png(result.reference))

    def write_summary(self, result: RunResult, target: Float32) -> None:
        """Write `summary.png`."""
        from fide_plugins.harness.figures import summary

        files.write_bytes(self.path / "summary.png", summary(result, target))

    def write_run(self, status: str = "running", result: RunResult | None = None) -> None:
        """Write `run.json`."""
        self._run |= {
            "status": status,
            "versions": machine.versions(),
            "machine": machine.machine(),
            "load": machine.load(),
            "written": _now(),
        }
        if result is not None:
            self._run["totals"] = {**result.summary(), **result.details()}
        if status == "finished":
            self._run["checksums"] = {name: checksum(self.path / name) for name in TABLES}
        files.write_text(self.path / "run.json", json.dumps(self._run, indent=2) + "\n")

    def remove_checkpoint(self) -> None:
        """Remove the state from which the run could go on."""
        for path in [self.path / "run.ckpt", *self.path.glob("optimizer-*.ckpt")]:
            with suppress(OSError):
                path.unlink()


def read_run(path: Path) -> dict[str, Any] | None:
    """Contents of `run.json` in the folder `path`; None if there is none.

    Raises RunDirectoryError (a FileExistsError) if it is damaged or of another version.
    """
    path = path / "run.json"
    if not path.exists():
        return None
    try:
        run = json.loads(path.read_text("utf-8"))
        if run["format"] != FORMAT:
            raise ValueError(f"format {run['format']!r}, and this version reads {FORMAT}")
        if not isinstance(run["settings"], dict) or not isinstance(run.get("resumed", []), list):
            raise ValueError("its settings are no dict, or its times of resuming no list")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RunDirectoryError(
            f"{path} is not the record of a run of this version ({error}); "
            "name another directory, or remove that file"
        ) from error
    return dict(run)


def check_settings(there: dict[str, Any], here: dict[str, Any], what: str) -> None:
    """Raise RunDirectoryError (a FileExistsError), naming the first setting that differs."""
    for key in [*here, *(k for k in there if k not in here)]:
        if there.get(key) != here.get(key):
            raise RunDirectoryError(
                f"{what} with other settings: {key} is "
                f"{there.get(key)!r} there and {here.get(key)!r} here; "
                "use the same settings, or name another directory"
            )


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
