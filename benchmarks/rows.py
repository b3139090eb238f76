"""Results as lines of JSON: read them, add one with what made it, find what is missing."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

from fide_plugins.experiments.run.machine import machine, versions

Row: TypeAlias = dict[str, Any]


def read(*paths: Path) -> list[Row]:
    """Rows of one or several files."""
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def rows_of(path: Path) -> list[Row]:
    """Rows of a file; none if it is not there yet."""
    return read(path) if path.exists() else []


def append(path: Path, row: Row) -> None:
    """Add a row with its provenance to a file, whose folder need not be there."""
    made_by = provenance()
    if twice := row.keys() & made_by.keys():
        raise ValueError(f"a row has {', '.join(sorted(twice))} already; append adds them")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps({**row, **made_by}) + "\n")


def provenance() -> Row:
    """Day, commit, packages with their versions, and machine of a measurement."""
    return {
        "date": time.strftime("%Y-%m-%d"),
        "commit": COMMIT,
        "packages": versions(),
        "machine": machine(),
    }


def commit() -> str | None:
    """Commit of the code, "-dirty" if files other than results differ from it; None without git."""
    try:
        name = _git("rev-parse", "--short=10", "HEAD")
        changed = _git("status", "--porcelain", "-uno", "--", ":/", f":(exclude,top){_RESULTS}")
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{name}-dirty" if changed else name


def _git(*words: str) -> str:
    here = Path(__file__).parent
    found = subprocess.check_output(["git", *words], cwd=here, text=True, stderr=subprocess.DEVNULL)
    return found.strip()


_RESULTS = "benchmarks/results"
COMMIT = commit()  # when the process began: others may commit while it measures


def missing(
    planned: Iterable[Row],
    path: Path,
    key: Callable[[Row], Any],
    share: str = "0/1",
    counts: Callable[[Row], bool] = lambda row: True,
) -> Iterator[Row]:
    """Those of a share "i/n" of the planned runs that the file does not have at their turn.

    The share is of all runs, whatever is done: so no two processes begin the same one.  The file is
    read again before each, since other processes add to it.  counts: whether a row of the file is
    as good as the planned run with its key.
    """
    part, parts = (int(number) for number in share.split("/"))
    for run in islice(planned, part, None, parts):
        if key(run) not in {key(row) for row in rows_of(path) if counts(row)}:
            yield run


def report(row: Row) -> None:
    """Show a row where a log is read."""
    print(json.dumps(row), file=sys.stderr, flush=True)
