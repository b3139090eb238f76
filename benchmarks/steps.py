"""Compares the search with steps and without where scenes have several basins, or noise.

    python benchmarks/steps.py                # what is missing; can be stopped at any time
    python benchmarks/steps.py --table

FIDE with its default and with `proposer="linear"`, which takes no steps, on forty targets of each
of four scenes that no other page reports (seeds 3000 to 3039).  On the targets of the suites
sprites, stick figures and San Miguel looked worse with steps; Robot has several basins, too.
Size, loss and *solved* are those of `image-fitting-v1`; 2,000 renders.

Each run is one line of benchmarks/results/steps.jsonl.  The seed of the optimizer is that of the
target less 3000.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import suites
from rows import Row, by_key, command, finished_by_all
from suite import reached

from fide_lab import run as harness
from fide_lab.run.prepare import make_task
from fide_lab.suite import read as read_suite

RESULTS = Path(__file__).parent / "results" / "steps.jsonl"
SUITE = read_suite("image-fitting-v1")
SCENES = ("sprites", "stick_figure", "robot", "san_miguel")
FIRST, TARGETS = 3000, 40
MARKS = (500, 1000, 2000)  # renders
CONFIGURATIONS: dict[str, dict[str, str]] = {"steps": {}, "no steps": {"proposer": "linear"}}


def key(row: Row) -> tuple[str, str]:
    """What makes a run."""
    return row["problem"], row["configuration"]


def parts(problem: str) -> tuple[str, int]:
    """Scene and number of a problem; the suite has fewer."""
    name, _, number = problem.rpartition("-")
    return name, int(number)


def planned() -> Iterator[Row]:
    """All runs, targets outermost."""
    for number in range(TARGETS):
        for scene in SCENES:
            for configuration in CONFIGURATIONS:
                yield {"problem": f"{scene}-{number}", "configuration": configuration}


def measure(run: Row) -> Row:
    """When one run has solved its problem, and its lowest losses."""
    problem, configuration = key(run)
    name, number = parts(problem)
    scene = SUITE.scenes[name]
    options = {**scene.options, **({"threads": 1} if name == "san_miguel" else {})}
    result = harness.run(
        make_task(name, scene.size, FIRST + number, options),
        "fide",
        scene.loss,
        MARKS[-1],
        seed=number,
        options=CONFIGURATIONS[configuration],
    )
    solved_at, losses = reached(result.losses, scene.solved, MARKS)
    seconds = round(result.wall_s, 1)
    return {**run, "solved_at": solved_at, "losses": losses, "seconds": seconds}


def table(rows: list[Row]) -> str:
    """Solved problems with steps and without, and who has the lower loss."""
    found = by_key(rows, key)
    whole = finished_by_all(found, CONFIGURATIONS)
    if not whole:
        sys.exit("no problem is finished with steps and without")
    lines = []
    for scene in SCENES:
        some = [problem for problem in whole if parts(problem)[0] == scene]
        lines += [suites.line(f"{scene}, {n:,}", _pairs(found, some, n)) for n in MARKS if some]
    lines += [suites.line(f"all, {n:,}", _pairs(found, whole, n)) for n in MARKS]
    return suites.table(lines, *CONFIGURATIONS)


def _pairs(found: dict[tuple[str, str], Row], problems: list[str], n: int) -> list[suites.Pair]:
    """When both have solved the problems, within n renders, and their lowest losses by then."""
    steps, none = CONFIGURATIONS
    return [suites.pair_of(p, found[p, steps], found[p, none], n) for p in problems]


if __name__ == "__main__":
    command(__doc__ or "", planned(), measure, RESULTS, key, table)
