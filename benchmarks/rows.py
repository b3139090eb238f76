"""Results as lines of JSON: read them, add one with what made it, find what is missing."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
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
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps({**row, **provenance()}) + "\n")


def provenance() -> Row:
    """Day, commit, packages with their versions, and machine of a measurement."""
    return {
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit(),
        "packages": versions(),
        "machine": machine(),
    }


@cache
def commit() -> str | None:
    """Commit of the code that runs, "-dirty" if files differ from it; None without git."""
    words = ["git", "describe", "--always", "--abbrev=10", "--dirty", "--exclude=*"]
    try:
        return subprocess.check_output(
            words, cwd=Path(__file__).parent, text=True, stderr=subprocess.DEVNULL
        ).strip()
    except (OSError, subprocess.CalledProcessError):
        return None


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
