"""The forward model compared with the inverse one: loss against renders, asked in different ways.

    python benchmarks/forward.py blobs lamps waves --targets 50-59 --configurations both/1 dfols/1
    python benchmarks/forward.py --table

A run has a task, a target, a configuration, a seed and a budget, and is a line of the file
benchmarks/results/forward.jsonl, appended when it is done; a second call does what is missing.
A configuration is a proposer and a way to ask: whole generations (all), 8 at a time, or one by one;
"both" takes steps between the generations when asked for 8 or 1; whole generations have none.
With options of --set a configuration needs a name of its own, --label.
A run ends at an MSE of 1e-11; marks beyond its end repeat the last value.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from forward_scenes import SCENES, SmoothScene
from moves import span
from numpy.typing import NDArray
from rows import Row, read, run_missing

import fide_tasks
from fide_lab import optimizers
from fide_plugins.recording.record import best_so_far
from fide_plugins.validation.options import parse_key_value

MARKS = (100, 200, 300, 500, 1000, 2000)
GOALS = (1e-4, 1e-6)
RESULTS = Path(__file__).parent / "results" / "forward.jsonl"
PROPOSERS: dict[str, dict[str, Any]] = {
    "inverse": {"proposer": "linear"},
    "forward": {"proposer": "forward"},
    "both": {"proposer": "both"},
}
TASKS: dict[str, dict[str, Any]] = {"spline": {"target": "random"}, "voronoi": {}, "robot": {}}

Floats: TypeAlias = NDArray[np.float64]


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if not arguments.table:
        run_missing(grid(arguments), lambda cell: run(cell, arguments), arguments.out, key)
    print(table(read(arguments.out), arguments))


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("tasks", nargs="*", default=[*SCENES, "spline", "voronoi", "robot"])
    add("--configurations", nargs="+", default=["inverse/all", "forward/all", "both/8", "both/1"])
    add("--targets", type=span, default=range(3), metavar="A-B")
    add("--seeds", type=int, default=1)
    add("--budget", type=int, default=2000)
    add("--set", nargs="*", default=[], metavar="KEY=VALUE", help="options of FIDE")
    add("--label", default="", help="added to the names of the configurations")
    add("--out", type=Path, default=RESULTS)
    add("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.set and not arguments.label:
        parser.error("options of --set make another configuration; name it with --label")
    return arguments


def grid(arguments: argparse.Namespace) -> Iterator[Row]:
    """All cells, targets outermost."""
    for target in arguments.targets:
        for seed in range(arguments.seeds):
            for task in arguments.tasks:
                for configuration in arguments.configurations:
                    name = configuration + arguments.label
                    yield {
                        "task": task, "target": target, "configuration": name, "seed": seed,
                        "budget": arguments.budget,
                    }  # fmt: skip


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    names = ("task", "target", "configuration", "seed", "budget")
    return tuple(row[name] for name in names)


def kind_of(row: Row) -> tuple[str, str, int]:
    """What the runs of one line of the table have in common."""
    return row["task"], row["configuration"], row["budget"]


def run(cell: Row, arguments: argparse.Namespace) -> Row:
    """One run; the row has the best loss (MSE) at each mark, and renders until each goal."""
    task = make_task(cell["task"], cell["target"])
    name, _, asked = cell["configuration"].removesuffix(arguments.label).partition("/")
    options = dict(parse_key_value(pair) for pair in arguments.set)
    if name in PROPOSERS:
        options = {**PROPOSERS[name], **options}
        optimizer = optimizers.make("fide", task.dim, task.target, seed=cell["seed"], **options)
    else:
        optimizer = optimizers.make(name, task.dim, task.target, seed=cell["seed"])
    n = None if asked == "all" else int(asked)
    start, rendering, losses = time.process_time(), 0.0, np.empty(0)
    while len(losses) < cell["budget"] and not (len(losses) and losses.min() < 1e-11):
        X = optimizer.ask() if n is None else optimizer.ask(n)
        before = time.process_time()
        images = task.render(X)
        mse = np.square(images.astype(np.float64) - task.target).mean(axis=(1, 2, 3))
        rendering += time.process_time() - before
        optimizer.tell(X, images, mse)
        losses = np.concatenate([losses, mse])
    best = best_so_far(losses)
    reached = [int(np.argmax(best <= goal)) + 1 if best[-1] <= goal else None for goal in GOALS]
    ms = 1000 * (time.process_time() - start - rendering) / len(losses)
    marks = [float(best[min(mark, len(best)) - 1]) for mark in MARKS]
    return {**cell, "losses": marks, "reached": reached, "ms": round(ms, 3)}


def make_task(name: str, target: int) -> Any:
    """A scene of this benchmark, or a task at 112 px."""
    if name in SCENES:
        return SmoothScene(name, target)
    return fide_tasks.make(name, size=112, seed=target, **TASKS[name])


def table(rows: list[Row], arguments: argparse.Namespace) -> str:
    """Geometric means at the marks; median renders until the goals, and how many get there."""
    columns = ["task", "configuration", "n", *map(str, MARKS), "until 1e-4", "until 1e-6", "ms"]
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    rows = [row for row in rows if row["task"] in arguments.tasks]
    kinds = dict.fromkeys(map(kind_of, rows))
    for kind in sorted(kinds, key=lambda kind: arguments.tasks.index(kind[0])):
        task, configuration, budget = kind
        group = [row for row in rows if kind_of(row) == kind]
        means = np.exp(np.log(np.maximum([row["losses"] for row in group], 1e-12)).mean(axis=0))
        cells = [f"{mean:.1e}" if m <= budget else "" for m, mean in zip(MARKS, means, strict=True)]
        cells += [_reached([row["reached"][i] for row in group]) for i in range(len(GOALS))]
        cells.append(f"{np.mean([row['ms'] for row in group]):.2f}")
        lines.append(f"| {task} | {configuration} | {len(group)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _reached(renders: list[int | None]) -> str:
    """Median of all runs, "-" where half of them do not get there, and how many do."""
    median = float(np.median([np.inf if r is None else r for r in renders]))
    shown = f"{median:.0f}" if np.isfinite(median) else "-"
    return f"{shown} ({sum(r is not None for r in renders)}/{len(renders)})"


if __name__ == "__main__":
    main()
