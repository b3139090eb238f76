"""Settings of rivals, chosen on targets that no table reports.

    python benchmarks/rivals.py --configurations "composite-bo, k = 4" --out runs/rivals.jsonl
    python benchmarks/rivals.py --table runs/rivals.jsonl

Scenes of `moves.py` at 64 x 64 pixels; the number of a target is the seed of the optimizer.  Every
run is one line of the output file; a second call does what is missing.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from moves import SCENES, make, span
from rows import Row, read, run_missing

from fide_lab import optimizers
from fide_plugins.recording.record import best_so_far

MARKS = (50, 100, 200, 300, 500, 1000, 2000)
SIZE = 64

CONFIGURATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "bipop-cma-es": ("bipop-cma-es", {}),
    "bipop-cma-es, sigma0 = 0.3": ("bipop-cma-es", {"sigma0": 0.3}),
    "lq-cma-es": ("lq-cma-es", {}),
    "lq-cma-es, sigma0 = 0.3": ("lq-cma-es", {"sigma0": 0.3}),
}
CONFIGURATIONS |= {
    f"{name}, k = {k}": (name, {"popsize": k, "smallest": 0.5**7})
    for name in ("turbo", "composite-bo")
    for k in (4, 10, 20)
}
CONFIGURATIONS["composite-bo, smallest = 0.5^12"] = ("composite-bo", {"smallest": 0.5**12})
CONFIGURATIONS |= {f"eki, patience = {n}": ("eki", {"patience": n}) for n in (3, 5, 10, 20)}
CONFIGURATIONS |= {f"eki, k = {k}": ("eki", {"popsize": k}) for k in (40, 60, 200)}
FORMER = ("eki, as before",)
"""Rows of older code, in the table alone."""


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    budget = arguments.budget
    run_missing(
        planned(arguments),
        lambda cell: {**cell, **run(cell, budget)},
        arguments.out,
        key,
        counts=lambda row: renders(row) >= budget,
    )


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--configurations", nargs="+", default=list(CONFIGURATIONS), choices=CONFIGURATIONS
    )
    parser.add_argument("--scenes", nargs="+", default=["arm", "lens", "spline"])
    parser.add_argument("--targets", type=span, default=range(50, 52), metavar="A-B")
    parser.add_argument("--budget", type=int, default=300, choices=MARKS, help="renders")
    parser.add_argument("--out", type=Path, default=Path("runs/rivals.jsonl"))
    parser.add_argument("--table", type=Path)
    return parser.parse_args()


def planned(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, configurations outermost."""
    for configuration in arguments.configurations:
        for scene in arguments.scenes:
            for target in arguments.targets:
                yield {"configuration": configuration, "scene": scene, "target": target}


def run(cell: Row, budget: int) -> Row:
    """The best loss at every mark, and the processor's seconds with the renders."""
    name, options = CONFIGURATIONS[cell["configuration"]]
    dim, target, render = make(SCENES[cell["scene"]], SIZE, cell["target"])
    opt = optimizers.make(name, dim, target, seed=cell["target"], **options)
    losses: list[float] = []
    start = time.process_time()
    while len(losses) < budget:
        X = opt.ask()[: budget - len(losses)]
        images = render(X)
        values = np.square(images - target).reshape(len(X), -1).mean(axis=1)
        opt.tell(X, images, values)
        losses.extend(values.tolist())
    best = best_so_far(losses)
    marks = {str(mark): float(best[mark - 1]) for mark in MARKS if mark <= budget}
    return {"best": marks, "cpu_s": round(time.process_time() - start, 1)}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["configuration"], row["scene"], row["target"]


def renders(row: Row) -> int:
    """Of a run, to its last mark."""
    return max(map(int, row["best"]))


def table(rows: list[Row]) -> str:
    """Geometric means over targets, at the marks that some run has reached, in Markdown.

    Of several runs of one cell the longest counts.
    """
    rows = list({key(row): row for row in sorted(rows, key=renders)}.values())
    marks = [m for m in map(str, MARKS) if any(m in row["best"] for row in rows)]
    lines = [f"| scene | | runs | {' | '.join(marks)} | CPU s |", "|---" * (len(marks) + 4) + "|"]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for configuration in (*CONFIGURATIONS, *FORMER):
            mine = [r for r in rows if (r["scene"], r["configuration"]) == (scene, configuration)]
            if mine:
                shown = " | ".join(cells(mine, marks))
                lines.append(f"| {scene} | {configuration} | {len(mine)} | {shown} |")
    return "\n".join(lines)


def cells(rows: list[Row], marks: list[str]) -> list[str]:
    """The means at the marks, and of the seconds."""
    means = []
    for mark in marks:
        reached = [row["best"][mark] for row in rows if mark in row["best"]]
        means.append(f"{np.exp(np.mean(np.log(reached))):.2g}" if reached else "")
    return [*means, f"{np.mean([row['cpu_s'] for row in rows]):.0f}"]


if __name__ == "__main__":
    main()
