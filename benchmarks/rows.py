"""Results as lines of JSON: read them, add one with what made it, find what is missing."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import fide_plugins
from fide_plugins.runtime.machine import machine, versions

Row: TypeAlias = dict[str, Any]
Key = TypeVar("Key", bound=Hashable)


def read(*paths: Path) -> list[Row]:
    """Rows of one or several files; ValueError for a line that is no row."""
    return [row for path in paths for row in _rows_in(path)]


def _rows_in(path: Path) -> Iterator[Row]:
    """Rows with their provenance, which the file has once for all rows with its name."""
    made: dict[str | None, Row] = {}
    for i, line in enumerate(path.read_text().splitlines(), 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise ValueError(f"{path}:{i} is no row; a cut-off line must be deleted") from error
        if "provenance" in row:
            made[row["made"]] = row["provenance"]
        else:
            yield row | made.get(row.pop("made", None), {})


def rows_of(path: Path) -> list[Row]:
    """Rows of a file; none if it is not there yet."""
    return read(path) if path.exists() else []


def append(path: Path, *rows: Row, made_by: Row | None = None) -> None:
    """Add rows with their provenance to a file, all or none; its folder need not be there.

    made_by: of a run that this process has not made.
    """
    made_by = made_by or provenance()
    if twice := made_by.keys() & {name for row in rows for name in row}:
        raise ValueError(f"a row has {', '.join(sorted(twice))} already; append adds them")
    name = hashlib.sha256(json.dumps(made_by, sort_keys=True).encode()).hexdigest()[:10]
    there = path.exists() and f'"made": "{name}"' in path.read_text()
    lines = [] if there else [{"made": name, "provenance": made_by}]
    lines += [{**row, "made": name} for row in rows]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(text)


def provenance() -> Row:
    """Day, commit, packages with their versions, machine, and kernels of a measurement."""
    used = kernels()  # first: it imports PyTorch, of whose threads `machine` then knows
    return {
        "date": time.strftime("%Y-%m-%d"),
        "commit": COMMIT,
        "packages": versions(),
        "machine": machine(),
        "kernels": used,
    }


def kernels() -> Row:
    """Instruction sets that NumPy's BLAS, NumPy and PyTorch use; other ones round differently."""
    import numpy as np
    import torch
    from threadpoolctl import threadpool_info

    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    return {
        "blas": sorted(
            {pool["architecture"] for pool in threadpool_info() if "architecture" in pool}
        ),
        "numpy": found[-1] if found else None,
        "torch": torch.backends.cpu.get_cpu_capability(),
    }


def commit() -> str | None:
    """Commit of the code, "-dirty" if files other than results differ from it.

    None without git, and where the package is not the one beside the benchmarks.
    """
    if Path(fide_plugins.__file__).parents[1] != Path(__file__).parents[1]:
        return None
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
    as good as the planned run with its key.  Exits for a share that is none.
    """
    numbers = re.fullmatch(r"(\d+)/(\d+)", share)
    if numbers is None or int(numbers[1]) >= int(numbers[2]):
        sys.exit(f"--part is I/N with I from 0 to N - 1, such as 0/2 and 1/2, not {share}")
    part, parts = int(numbers[1]), int(numbers[2])
    for run in islice(planned, part, None, parts):
        if key(run) not in _there(path, key, counts):
            yield run


def _there(path: Path, key: Callable[[Row], Any], counts: Callable[[Row], bool]) -> set[Any]:
    """Keys of the rows of a file that count."""
    return {key(row) for row in rows_of(path) if counts(row)}


def run_missing(
    planned: Iterable[Row],
    measure: Callable[[Row], Row],
    path: Path,
    key: Callable[[Row], Any],
    share: str = "0/1",
    counts: Callable[[Row], bool] = lambda row: True,
    clear: Callable[[Row], None] = lambda run: None,
) -> None:
    """Measure what is `missing`; each row is added to the file, and shown, when its run ends.

    clear: removes what a run has kept to go on from, if there is something; called when its row is
        in the file, and first of all for rows that are there, after a kill between the two.
    """
    runs, there = list(planned), _there(path, key, counts)
    for run in runs:
        if key(run) in there:
            clear(run)
    for run in missing(runs, path, key, share, counts):
        row = measure(run)
        append(path, row)
        report(row)
        clear(run)


def command(
    about: str,
    planned: Iterable[Row],
    measure: Callable[[Row], Row],
    path: Path,
    key: Callable[[Row], Any],
    table: Callable[[list[Row]], str],
) -> None:
    """Command line of a program without options of its own: runs what is missing, or the table."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", action="store_true")
    parser.add_argument(
        "--part", default="0/1", metavar="I/N", help="the runs of this process, 0/2 or 1/2"
    )
    parser.add_argument("--out", type=Path, default=path, metavar="FILE")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
    else:
        run_missing(planned, measure, arguments.out, key, arguments.part)


def by_key(rows: Iterable[Row], key: Callable[[Row], Key]) -> dict[Key, Row]:
    """Rows by what makes their run; exits where two have made the same one."""
    found: dict[Key, Row] = {}
    for row in rows:
        if key(row) in found:
            sys.exit(f"two rows of one run: {key(row)}; keep one of them")
        found[key(row)] = row
    return found


def finished_by_all(
    found: Mapping[tuple[str, Any], Row], configurations: Collection[Any]
) -> list[str]:
    """Problems that all configurations have finished; found: rows by these two."""
    problems = dict.fromkeys(problem for problem, _ in found)
    return [p for p in problems if all((p, each) in found for each in configurations)]


def report(row: Row) -> None:
    """Show a row where a log is read."""
    print(json.dumps(row), file=sys.stderr, flush=True)
