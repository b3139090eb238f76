"""The suite image-fitting-v1 for many optimizers: a run at a time, over days and machines.

    python benchmarks/suite.py                        # what is missing; can be stopped at any time
    python benchmarks/suite.py --from runs/suite      # take over finished runs of `fide compare`
    python benchmarks/suite.py --table
    python benchmarks/suite.py --picture docs/images/suite.png          # data profile
    python benchmarks/suite.py --picture docs/images/suite_performance.png --performance
    python benchmarks/suite.py --budget 2000 --scenes arm,lens --optimizers composite-bo

`fide compare --suite` keeps every run in a folder of its own; here it is one line of the output
file: the render that solved the problem, and the lowest loss at each budget.  So runs of several
machines come into one file.  Targets come one after the other.  Slow optimizers and slow scenes may
have runs that end at an earlier budget of the suite.  The table and the pictures show the problems
that all of the optimizers have finished, up to the budget that is asked for, by the functions that
make the page of a suite.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from quality import append, rows_of

from fide_plugins.experiments import run as harness
from fide_plugins.experiments.compare import results
from fide_plugins.experiments.compare.configuration import Configuration
from fide_plugins.experiments.report import svg
from fide_plugins.experiments.report.tables import markdown
from fide_plugins.experiments.run.machine import machine
from fide_plugins.experiments.suite import figures, profiles, read
from fide_plugins.experiments.suite.scores import Scores
from fide_plugins.experiments.suite.tables import by_scene, totals

SUITE = read("image-fitting-v1")
RESULTS = Path(__file__).parent / "results" / "suite.jsonl"
OPTIMIZERS = (
    "fide", "cma", "cma:popsize=50", "bipop-cma-es", "eki", "dual-annealing:step=0.001",
    "zerograds",
)  # fmt: skip
CHEAP = ("voronoi", "spline", "robot", "lamps", "sprites", "arm", "lens", "stick_figure")
"""Scenes with renders of a few milliseconds."""

Row = dict[str, Any]


def missing(
    rows: list[Row], scenes: Sequence[str], optimizers: Sequence[str], targets: int, budget: int
) -> Iterator[tuple[str, str]]:
    """Problem and optimizer of each run that is missing, targets outermost."""
    done = {(row["problem"], row["optimizer"]) for row in long_enough(rows, budget)}
    for number in range(targets):
        for scene in scenes:
            for optimizer in optimizers:
                if (f"{scene}-{number}", optimizer) not in done:
                    yield f"{scene}-{number}", optimizer


def long_enough(rows: list[Row], budget: int) -> list[Row]:
    """Rows of runs that had so many renders."""
    return [row for row in rows if str(budget) in row["losses"]]


def measure(problem: str, optimizer: str, budget: int) -> Row:
    """One run, as `fide compare --suite` has it with `--budget`."""
    scene, _ = SUITE.problem(problem)
    configuration = Configuration.parse(optimizer)
    result = harness.run(
        problem,
        configuration.name,
        scene.loss,
        budget,
        seed=int(problem.rpartition("-")[2]),
        task_options={"suite": SUITE.name},
        options=configuration.options,
        keep=harness.Keep(film=False, summary=False, checkpoint=False),
    )
    best = np.fmin.accumulate(result.losses)
    hits = np.flatnonzero(best <= scene.solved)
    solved_at = int(hits[0]) + 1 if len(hits) else None
    losses = {str(b): float(best[b - 1]) for b in SUITE.budgets if b <= budget}
    return row_of(problem, optimizer, solved_at, losses, result.wall_s)


def taken_over(folder: Path) -> Iterator[Row]:
    """Rows of the finished runs of a comparison of this suite, with its whole budget."""
    found = results.read(folder)
    if found.settings["task_options"] != {"suite": SUITE.name}:
        sys.exit(f"{folder} is no comparison of {SUITE.name}")
    for run in found.runs:
        curve = run.curve
        if run.status != "finished" or curve is None or curve.ends["renders"] < SUITE.budgets[-1]:
            continue
        at = curve.reaches("renders", SUITE.problem(run.key.task)[0].solved)
        losses = curve.value("renders", SUITE.budgets).tolist()
        yield row_of(
            run.key.task,
            run.key.configuration,
            int(at) if np.isfinite(at) else None,
            dict(zip(map(str, SUITE.budgets), losses, strict=True)),
            curve.ends["seconds"],
        )


def row_of(
    problem: str, optimizer: str, solved_at: int | None, losses: dict[str, float], seconds: float
) -> Row:
    """A line of the file; seconds: wall time."""
    return {
        "problem": problem,
        "optimizer": optimizer,
        "solved_at": solved_at,
        "losses": losses,
        "seconds": round(seconds, 1),
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
    }


def scores(rows: list[Row], optimizers: Sequence[str], budget: int) -> Scores:
    """Of the problems that all of these optimizers have finished, up to the budget."""
    rows = long_enough(rows, budget)
    found = {(row["problem"], row["optimizer"]): row for row in rows}
    budgets = tuple(b for b in SUITE.budgets if b <= budget)
    there = dict.fromkeys(row["problem"] for row in rows)
    problems = [p for p in there if all((p, label) in found for label in optimizers)]
    if not problems:
        sys.exit("no problem is finished by all of these optimizers")
    table = [[found[p, label] for label in optimizers] for p in problems]
    t = np.array([[row["solved_at"] or np.inf for row in line] for line in table])
    losses = [[[row["losses"][str(b)] for row in line] for line in table] for b in budgets]
    return Scores(
        SUITE, tuple(optimizers), tuple(problems), len(problems), budgets,
        profiles.within(t, budget), np.array(losses),
    )  # fmt: skip


def picture(found: Scores, *, performance: bool) -> bytes:
    """Data profile, or performance profile at the last budget, as PNG."""
    if performance:
        return svg.png(figures.performance_profile(found, found.labels, found.budgets[-1]))
    return svg.png(figures.data_profile(found, found.labels))


def main() -> None:
    """Run what is missing, or show what was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--scenes", default=",".join(CHEAP), metavar="A,B", help=f"of {', '.join(SUITE.scenes)}")
    add("--optimizers", default=",".join(OPTIMIZERS), metavar="A,B")
    add("--targets", type=int, default=len(SUITE.targets), metavar="N", help="the first N")
    add("--part", default="0/1", metavar="I/N", help="the runs of this process")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    add("--from", type=Path, dest="folder", metavar="DIR", help="of fide compare --suite")
    add("--budget", type=int, default=SUITE.budgets[-1], choices=SUITE.budgets, help="renders")
    add("--table", action="store_true")
    add("--picture", type=Path, metavar="PNG")
    add("--performance", action="store_true", help="a performance profile as picture")
    arguments = parser.parse_args()
    rows, optimizers = rows_of(arguments.out), arguments.optimizers.split(",")
    scenes, _ = SUITE.chosen(arguments.scenes.split(","), None)
    if arguments.table or arguments.picture:
        chosen = [r for r in rows if r["problem"].rpartition("-")[0] in scenes]
        found = scores(chosen, optimizers, arguments.budget)
        if arguments.picture:
            drawn = picture(found, performance=arguments.performance)
            arguments.picture.write_bytes(drawn)
        else:
            print(*(markdown(make(found, optimizers)) for make in (totals, by_scene)), sep="\n\n")
    elif arguments.folder:
        whole = long_enough(rows, SUITE.budgets[-1])
        done = {(row["problem"], row["optimizer"]) for row in whole}
        for row in taken_over(arguments.folder):
            if (row["problem"], row["optimizer"]) not in done:
                append(arguments.out, row)
    else:
        part, parts = map(int, arguments.part.split("/"))
        budget = arguments.budget
        for i, run in enumerate(missing(rows, scenes, optimizers, arguments.targets, budget)):
            if i % parts == part:
                row = measure(*run, budget)
                append(arguments.out, row)
                print(json.dumps(row), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
