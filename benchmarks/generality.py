"""FIDE and CMA-ES on tasks that were not used for tuning: other targets, and many parameters.

    python benchmarks/generality.py --out benchmarks/results/generality.jsonl
    python benchmarks/generality.py --table benchmarks/results/generality.jsonl

The two tasks of `quality.py` with targets that were not used during development (Spline: random
strokes, which it can draw), and a photograph, the one that comes with matplotlib, fitted by 20 and
by 60 Voronoi cells of five parameters each.  Every run is one line of the output file; a second
call does the missing runs.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import matplotlib
from quality import CONFIGURATIONS, measured, run_configurations
from rows import Row, read

import fide_tasks
from fide_lab import run as harness
from fide_plugins.validation import images

BUDGET, SIZE = 4000, 112
MARKS = ("500", "1000", "2000", "4000")
SOLVED = 1e-3
TARGETS, SEEDS = range(10, 16), (20, 21)
PHOTO_SEEDS = range(4)
CELLS = {"photo, 100 parameters": 20, "photo, 300 parameters": 60}
OPTIONS: dict[str, dict[str, Any]] = {"spline": {"target": "random"}}
RACERS = ("FIDE", "CMA-ES, default k, restarts")


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("runs/generality.jsonl"))
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", type=Path, nargs="+")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(*arguments.table)))
        return
    run_configurations(
        grid(),
        {configuration: CONFIGURATIONS[configuration] for configuration in RACERS},
        arguments.out,
        arguments.part,
        run,
    )


def grid() -> Iterator[Row]:
    """All cells, seeds outermost."""
    tasks = [(seed, task, target)
             for seed in SEEDS for task in ("voronoi", "spline") for target in TARGETS]  # fmt: skip
    tasks += [(seed, task, 0) for seed in PHOTO_SEEDS for task in CELLS]
    for seed, task, target in tasks:
        for configuration in RACERS:
            yield {
                "task": task,
                "target": target,
                "configuration": configuration,
                "seed": seed,
                "size": SIZE,
                "budget": BUDGET,
            }


def run(cell: Row, optimizer: str, options: dict[str, Any]) -> Row:
    """One run, and its best loss at every mark."""
    name = cell["task"]
    given: dict[str, Any] = {"size": SIZE, "task_seed": cell["target"]}
    given["task_options"] = OPTIONS.get(name, {})
    task: Any = name
    if name in CELLS:
        task, given = drawn_by(CELLS[name]), {}
    result = harness.run(task, optimizer, "mse", BUDGET, cell["seed"], options=options, **given)
    return measured(cell, result)


def drawn_by(cells: int) -> Any:
    """Task of a photograph, 112 x 95 pixels."""
    path = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    return fide_tasks.make("voronoi", target=images.load(path, max_side=SIZE), cells=cells)


def table(rows: list[Row]) -> str:
    """Medians over targets and seeds, and how many runs are solved, in Markdown."""
    marks = " | ".join(f"{int(m):,}" for m in MARKS)
    lines = [f"| | runs | {marks} | below {SOLVED} at {BUDGET:,} |", "|---" * 7 + "|"]
    for task in dict.fromkeys(row["task"] for row in rows):
        for configuration in RACERS:
            best = [
                row["best"]
                for row in rows
                if row["task"] == task and row["configuration"] == configuration
            ]
            medians = " | ".join(f"{statistics.median(b[m] for b in best):#.3g}" for m in MARKS)
            solved = sum(b[str(BUDGET)] < SOLVED for b in best)
            lines.append(
                f"| {task}, {configuration} | {len(best)} | {medians} | {solved} of {len(best)} |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
