"""What the guard against misleading images costs on honest images: paired runs with and without it.

    python benchmarks/guard.py --out benchmarks/results/guard.jsonl
    python benchmarks/guard.py --table benchmarks/results/guard.jsonl

Every run uses the task's own images and one of the losses.  `guard_images` is on or off; seeds and
targets are the same.  The table shows the median best losses and the geometric mean of their ratio,
with a 95 % interval by bootstrap over the pairs.  A ratio above 1 is the cost of the guard.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, read, run_missing

from fide_lab import run as harness
from fide_plugins.recording.record import best_so_far

TASKS, LOSSES = ("voronoi", "spline"), ("loi", "perceptual")
MARKS = (1000, 2000, 4000)
SMALLEST = 1e-9  # loss; below, runs have found the answer


def planned(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, seeds outermost."""
    cells = product(range(arguments.seeds), arguments.losses, arguments.tasks, (True, False))
    for seed, loss, task, guard in cells:
        yield {"task": task, "loss": loss, "seed": seed, "guard": guard, "size": arguments.size}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["task"], row["loss"], row["seed"], row["guard"], row["size"]


def run(cell: Row) -> Row:
    """One row; the seed also chooses the target."""
    result = harness.run(
        cell["task"],
        "fide",
        cell["loss"],
        MARKS[-1],
        cell["seed"],
        size=cell["size"],
        task_seed=cell["seed"] % 4,
        options={"guard_images": cell["guard"]},
    )
    best = best_so_far(result.losses)
    return {
        **cell,
        "best": {str(mark): float(best[mark - 1]) for mark in MARKS},
        "wall_s": round(result.wall_s, 1),
    }


def table(rows: list[Row]) -> str:
    """One line a task, loss and mark."""
    lines = [
        "| task | loss | pairs | renders | guarded | not guarded | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for task, loss, mark in product(TASKS, LOSSES, MARKS):
        of = {
            guard: {
                row["seed"]: max(row["best"][str(mark)], SMALLEST)
                for row in rows
                if (row["task"], row["loss"], row["guard"]) == (task, loss, guard)
            }
            for guard in (True, False)
        }
        seeds = sorted(of[True].keys() & of[False].keys())
        if seeds:
            on, off = ([of[guard][seed] for seed in seeds] for guard in (True, False))
            medians = f"{statistics.median(on):.3g} | {statistics.median(off):.3g}"
            lines.append(
                f"| {task} | {loss} | {len(seeds)} | {mark:,} | {medians} | {mean(on, off)} |"
            )
    return "\n".join(lines)


def mean(on: list[float], off: list[float]) -> str:
    """Geometric mean of on / off with its interval."""
    logs = np.log(np.array(on) / np.array(off))
    means = np.random.default_rng(0).choice(logs, (4000, len(logs))).mean(axis=1)
    low, high = np.exp(np.quantile(means, [0.025, 0.975]))
    return f"{np.exp(logs.mean()):.2f} ({low:.2f} to {high:.2f})"


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--losses", nargs="+", default=list(LOSSES))
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--out", type=Path, default=Path("runs/guard.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(planned(arguments), run, arguments.out, key)


if __name__ == "__main__":
    main()
