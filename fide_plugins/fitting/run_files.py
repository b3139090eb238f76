"""Files of a run directory: its optimizer, and a copy of all."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from fide_plugins.recording.directory import is_of_a_run, results_in
from fide_plugins.recording.json_record import RunDirectoryError, read_run
from fide_plugins.recording.run_checkpoint import is_saved, with_optimizer

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["copy_run", "optimizer_in"]


def optimizer_in(path: Path) -> FIDE | None:
    """The optimizer of the run in a folder; None without a checkpoint, or if it is not FIDE's.

    Raises CheckpointError (a ValueError), OSError.
    """
    from fide_plugins.fide import FIDE

    run = read_run(path)
    if run is None or run["settings"].get("optimizer") != "fide" or not is_saved(path):
        return None
    return with_optimizer(path, FIDE.load)


def copy_run(source: Path, to: Path) -> None:
    """Copy the files of a run into a folder without one.

    Raises RunDirectoryError (a FileExistsError) if there is one; OSError.
    """
    if (to / "run.json").exists() or results_in(to):
        raise RunDirectoryError(f"{to} holds a run already; name another directory")
    to.mkdir(parents=True, exist_ok=True)
    for file in sorted(source.iterdir(), key=lambda file: file.name == "run.json"):  # it last
        if is_of_a_run(file.name) and file.is_file() and not file.is_symlink():
            shutil.copyfile(file, to / file.name)
