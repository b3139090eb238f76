"""Results of a file or a loss that has changed since: kept as they are, never mixed with new ones.

The file is that of an optimizer, of a task, of a learned model, or of the weights of a pretrained
encoder.  The runs of an optimizer, of a task, or with a loss, belong together: the report takes
medians over them, and pairs them with those of others.  So where some are finished and their file
or loss has changed since, no more are added.  Where all are finished they can still be reported.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from fide_lab.compare.configuration import as_file_name
from fide_lab.compare.one_run import State
from fide_lab.compare.plan import RunKey
from fide_plugins.recording.json_record import RunDirectoryError, read_run
from fide_plugins.recording.sources import edited, file_of, loss_reference, versions_there
from fide_plugins.runtime.messages import warn_user

__all__ = ["check_versions", "warn_of_mixed"]


def check_versions(
    path: Path,
    sources: Mapping[str, str],
    states: Mapping[RunKey, State],
    there: Iterable[RunKey],
) -> None:
    """Compare the versions of finished runs with the present ones.

    path: folder of the comparison; sources: those of its plan, pretrained weights, losses.
    states: of the runs of the plan; there: all runs of the comparison so far.

    Warns once for each file or loss that has changed since all its runs, of an optimizer, a task or
    a loss, were finished.  Raises RunDirectoryError (a FileExistsError), with the remedy, if only
    some of them are.
    """
    if not sources:
        return
    old: dict[str, list[str]] = defaultdict(list)  # folders of results of each reference
    growing = set()  # folders in which runs are to be done
    for key in dict.fromkeys([*states, *there]):
        if key in states and states[key].kind != "finished":
            growing |= {"cells", _of_task(key), _of_loss(key), _of_optimizer(key)}
            continue
        for reference in _edited(path / key.folder, sources):
            folder = _belonging(reference, key)
            if folder not in old[reference]:
                old[reference].append(folder)
    for reference, folders in old.items():
        mixed = [folder for folder in folders if folder in growing]
        if mixed:
            raise RunDirectoryError(
                f"{file_of(reference)} has changed since runs with {reference} in {path} were "
                "finished, and more are to be done, which do not belong with them: undo the "
                f"change, name another directory, or delete {path / mixed[0]} to do all of them "
                "again"
            )
        if folders:
            warn_user(
                f"{file_of(reference)} has changed since the runs with {reference} in {path} were "
                "finished: the report has the results of the earlier version; for those of the "
                "present one name another directory, or delete "
                f"{' and '.join(str(path / folder) for folder in folders)} and do them again"
            )


def warn_of_mixed(path: Path, finished: Iterable[tuple[RunKey, Mapping[str, Any]]]) -> None:
    """Warn of finished runs that belong together and are of several versions of a file.

    They are where the file has changed while runs were at work.
    path: folder of the comparison; finished: its finished runs, each with its `run.json`.
    """
    versions: dict[tuple[str, str], set[str]] = defaultdict(set)  # by reference and folder
    for key, run in finished:
        for reference, there in versions_there(run).items():
            versions[reference, _belonging(reference, key)].update(there)
    for (reference, folder), found in versions.items():
        if len(found) > 1:
            warn_user(
                f"{file_of(reference)} has changed while runs with {reference} in {path} were at "
                f"work: the report has results of {len(found)} versions of it; for those of one "
                f"delete {path / folder} and do them again"
            )


def _edited(folder: Path, sources: Mapping[str, str]) -> list[str]:
    """References to files that have changed since the run in `folder` was finished."""
    try:
        run = read_run(folder)
    except (RunDirectoryError, OSError):  # it will be repeated, or reported as damaged
        return []
    finished = run is not None and run.get("state") == "finished"
    return edited(versions_there(run), sources) if finished else []


def _belonging(reference: str, key: RunKey) -> str:
    """Folder, as a pattern, of all runs that belong together with a run that has the reference."""
    if reference == key.task:
        return _of_task(key)
    if reference.startswith(loss_reference("")):
        return _of_loss(key) if reference == loss_reference(key.loss) else "cells"  # a metric
    return _of_optimizer(key)


def _of_task(key: RunKey) -> str:
    return f"cells/{as_file_name(key.task)}"


def _of_loss(key: RunKey) -> str:
    return f"cells/*/{as_file_name(key.loss)}"


def _of_optimizer(key: RunKey) -> str:
    """That of its configuration, whose options name the models."""
    return f"cells/*/*/{as_file_name(key.configuration)}"
