"""Results of a user's file that was edited since: kept as they are, never mixed with new ones.

The runs of an optimizer, or of a task, belong together: the report takes medians over them, and
pairs them with those of others.  So where some are finished and their file has changed since, no
more are added.  Where all are finished they can still be reported.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from fide_plugins.experiments.compare.configuration import as_file_name, split
from fide_plugins.experiments.compare.one_run import State
from fide_plugins.experiments.compare.plan import RunKey
from fide_plugins.recording.directory import RunDirectoryError, read_run
from fide_plugins.recording.sources import edited, file_of, versions_there
from fide_plugins.runtime.warn import warn_user

__all__ = ["check_versions"]


def check_versions(
    path: Path,
    sources: Mapping[str, str],
    states: Mapping[RunKey, State],
    there: Iterable[RunKey],
) -> None:
    """Compare the versions of finished runs with the present ones.

    path: folder of the comparison; sources: those of its plan, see `Plan.sources`.
    states: of the runs of the plan; there: all runs of the comparison so far.

    Warns once for each file that has changed since all its runs of an optimizer or a task were
    finished.  Raises RunDirectoryError (a FileExistsError), with the remedy, if only some of them
    are.
    """
    if not sources:
        return
    old: dict[str, list[str]] = defaultdict(list)  # folders of results of each reference
    growing = set()  # folders in which runs are to be done
    for key in dict.fromkeys([*states, *there]):
        changed = _edited(path / key.folder, sources)
        for reference, folder in _belonging(key):
            if key in states and states[key].kind != "finished":
                growing.add(folder)
            elif reference in changed and folder not in old[reference]:
                old[reference].append(folder)
    for reference, folders in old.items():
        mixed = [folder for folder in folders if folder in growing]
        if mixed:
            raise RunDirectoryError(
                f"{file_of(reference)} has changed since runs of {reference} in {path} were "
                "finished, and more are to be done, which do not belong with them: undo the "
                f"change, name another directory, or delete {path / mixed[0]} to do all of them "
                "again"
            )
        if folders:
            warn_user(
                f"{file_of(reference)} has changed since the runs of {reference} in {path} were "
                "finished: the report has the results of the earlier version; for those of the "
                "present one name another directory, or delete "
                f"{' and '.join(str(path / folder) for folder in folders)} and do them again"
            )


def _edited(folder: Path, sources: Mapping[str, str]) -> list[str]:
    """References to files that have changed since the run in `folder` was finished."""
    try:
        run = read_run(folder)
    except (RunDirectoryError, OSError):  # it will be repeated, or reported as damaged
        return []
    finished = run is not None and run.get("status") == "finished"
    return edited(versions_there(run), sources) if finished else []


def _belonging(key: RunKey) -> Iterator[tuple[str, str]]:
    """Names of what a run uses, each with the folder, as a pattern, of all runs that use it."""
    optimizer, _ = split(key.configuration)
    yield key.task, f"cells/{as_file_name(key.task)}"
    yield optimizer, f"cells/*/*/{as_file_name(key.configuration)}"
