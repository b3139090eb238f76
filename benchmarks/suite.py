"""A suite for many optimizers: a run at a time, over days and machines.

    python benchmarks/suite.py                        # what is missing; can be stopped at any time
    python benchmarks/suite.py --from runs/suite      # take over finished runs of `fide compare`,
                                                      # of any budget of the suite
    python benchmarks/suite.py --table
    python benchmarks/suite.py --picture docs/images/suite.png          # data profile
    python benchmarks/suite.py --page runs/suite/report.html             # all of them on a page
    python benchmarks/suite.py --budget 2000 --scenes arm,lens --optimizers dfols
    python benchmarks/suite.py --suite image-fitting-v2   # or -v3, image-fitting-foreign-v1

`fide compare --suite` keeps every run in a folder of its own; here it is one line of the output
file: the render that solved the problem, and the lowest loss at each budget.  So runs of several
machines come into one file.  Until a run ends, it has a folder beside the file, from which the next
call goes on.  Targets come one after the other.  Slow optimizers and slow scenes may have runs that
end at an earlier budget of the suite.  The table and the pictures show the problems that all of the
optimizers have finished, up to the budget that is asked for, by the functions that make the page of
a suite.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, append, finished_by_all, missing, rows_of, run_missing

from fide_lab import run as harness
from fide_lab.cli.arguments import names
from fide_lab.compare import results
from fide_lab.compare.plan import Configuration
from fide_lab.report import plots
from fide_lab.report.tables import markdown
from fide_lab.suite import Suite, names as suites, read
from fide_lab.suite.page import (
    Origin,
    by_scene,
    data_profile_figure,
    lowest,
    totals,
    write_scores,
)
from fide_lab.suite.problems import check_budgets
from fide_lab.suite.scores import Scores, within
from fide_plugins.cli.arguments import whole
from fide_plugins.errors import OptionError
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results"
OPTIMIZERS = (
    "fide", "cma", "cma:popsize=50", "eki", "dual-annealing:step=0.001", "zerograds",
    "dfols",
)  # fmt: skip
IN_PICTURE = {
    "fide": "FIDE", "cma": "CMA-ES", "cma:popsize=50": "CMA-ES, 50 a generation", "eki": "EKI",
    "dual-annealing:step=0.001": "dual annealing", "zerograds": "ZeroGrads", "dfols": "DFO-LS",
}  # fmt: skip
CHEAP = ("voronoi", "spline", "robot", "lamps", "sprites", "arm", "lens", "stick_figure")
"""Scenes with renders of a few milliseconds."""


def label_of(optimizer: str) -> str:
    """Name in the file of what was typed, options in alphabetical order.

    Exits for what is not written as an optimizer, and for one with a budget of its own.
    """
    try:
        configuration = Configuration.parse(optimizer)
        check_budgets([configuration])
    except OptionError as error:
        sys.exit(str(error))
    return configuration.label


def file_of(suite: Suite) -> Path:
    """Of each suite its own: problems of two suites have the same names."""
    return RESULTS / f"suite_{suite.name.removeprefix('image-fitting-').replace('-', '_')}.jsonl"


def planned(
    suite: Suite, scenes: Sequence[str], optimizers: Sequence[str], targets: int
) -> Iterator[Row]:
    """All runs, targets outermost."""
    for problem in suite.problems(scenes, targets):
        for optimizer in optimizers:
            yield {"problem": problem, "optimizer": optimizer}


def budget_of(suite: Suite, budget: int | None) -> int:
    """The budget, one of the suite's; None: its last.  Exits for any other."""
    if budget is not None and budget not in suite.budgets:
        known = ", ".join(map(str, suite.budgets))
        sys.exit(f"{suite.name} has no budget of {budget} renders; it has {known}")
    return budget or suite.budgets[-1]


def key(row: Row) -> tuple[str, str]:
    """What makes a run; it may have any budget of the suite."""
    return row["problem"], row["optimizer"]


def long_enough(budget: int) -> Callable[[Row], bool]:
    """Whether a run had so many renders."""
    return lambda row: str(budget) in row["losses"]


def measure(suite: Suite, budget: int, parts: Path, run: Row) -> Row:
    """One run, as `fide compare --suite` has it with `--budget`; parts: see `part_of`."""
    problem, optimizer = key(run)
    name, number = suite.parts(problem)
    scene = suite.scenes[name]
    configuration = Configuration.parse(optimizer)
    result = harness.run(
        problem,
        configuration.name,
        scene.loss,
        budget,
        seed=number,
        task_options={"suite": suite.name},
        options=configuration.options,
        out=part_of(budget, parts, run),
        resume=True,
        checkpoint_every=60,
        keep=harness.Keep(summary=False),
    )
    at: dict[str, Float64] = {"renders": result.improvements.astype(np.float64) + 1}
    curve = results.Curve(
        at, {"seconds": result.wall_s}, result.losses[result.improvements], result.metrics
    )
    return row_of_curve(suite, problem, optimizer, curve, budget)


def row_of_curve(
    suite: Suite, problem: str, optimizer: str, curve: results.Curve, budget: int
) -> Row:
    """Row of a run with that budget; the errors take the place of losses where they judge."""
    scene, _ = suite.problem(problem)
    at = curve.reaches("renders", scene.solved, scene.metric)
    budgets = [b for b in suite.budgets if b <= budget]
    losses = {str(b): curve.loss_at("renders", b, scene.metric) for b in budgets}
    solved_at = int(at) if np.isfinite(at) else None
    return row_of(problem, optimizer, solved_at, losses, curve.ends["seconds"])


def part_of(budget: int, parts: Path, run: Row) -> Path:
    """Folder of a run from which it goes on; parts: has one of each that has begun."""
    return parts / re.sub(r"[^\w.=-]+", "-", "-".join([*key(run), str(budget)]))


def take_over(suite: Suite, found: results.Results, out: Path) -> str:
    """Add the finished runs of a comparison of this suite to the file; says how many, and why.

    A row is of the day of the comparison's last call, which may not be that of its run.

    Exits for another suite's, and for one of a budget that the suite has not.
    """
    if found.settings["task_options"] != {"suite": suite.name}:
        sys.exit(f"this is no comparison of {suite.name}")
    budget = budget_of(suite, int(found.settings["budget"]))
    days = [call["started"][:10] for call in found.calls]
    made_by = {"date": days[-1], "commit": None, "packages": found.versions,
               "machine": found.machine}  # fmt: skip
    rows = [
        row_of_curve(suite, run.key.task, run.key.configuration, run.curve, budget)
        for run in found.runs
        if run.curve is not None
    ]
    taken = 0
    for row in missing(rows, out, key, counts=long_enough(budget)):
        append(out, row, made_by=made_by)
        taken += 1
    others = Counter(run.state for run in found.runs if run.curve is None)
    there = {f"in {out} already": len(rows) - taken} if taken < len(rows) else {}
    why = [f"{n} {status}" for status, n in (there | others).items()]
    return f"{taken} of {len(found.runs)} runs are taken{'; '.join(['', *why])}"


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
    }


def longest(
    rows: Sequence[Row], optimizers: Sequence[str], budget: int
) -> dict[tuple[str, str], Row]:
    """Runs of these optimizers by their key: of several of one problem the longest."""
    rows = [row for row in rows if row["optimizer"] in optimizers and long_enough(budget)(row)]
    twice = {p for p, n in Counter((*key(row), *row["losses"]) for row in rows).items() if n > 1}
    if twice:
        sys.exit(f"two rows of one run: {twice}; keep one of them")
    found: dict[tuple[str, str], Row] = {}
    for row in rows:
        if len(row["losses"]) >= len(found.setdefault(key(row), row)["losses"]):
            found[key(row)] = row
    return found


def scores(suite: Suite, rows: list[Row], optimizers: Sequence[str], budget: int) -> Scores:
    """Of the problems that all of these optimizers have finished, up to the budget."""
    found = longest(rows, optimizers, budget)
    budgets = tuple(b for b in suite.budgets if b <= budget)
    problems = finished_by_all(found, optimizers)
    if not problems:
        known = ", ".join(dict.fromkeys(label for _, label in found)) or "none of them"
        sys.exit(f"no problem is finished by all of these optimizers; by some: {known}")
    table = [[found[p, label] for label in optimizers] for p in problems]
    t = np.array([[row["solved_at"] or np.inf for row in line] for line in table])
    losses = [[[row["losses"][str(b)] for row in line] for line in table] for b in budgets]
    return Scores(
        suite, tuple(optimizers), tuple(problems), budgets,
        within(t, budget), np.array(losses),
    )  # fmt: skip


def origin(rows: Sequence[Row]) -> Origin:
    """What was typed, and what made these rows: their days, processors and packages."""
    days = sorted(row["date"] for row in rows)
    machine = {
        "runs": len(rows),
        "days": f"{days[0]} to {days[-1]}",
        "processors": _each(row["machine"]["cpu"] for row in rows),
    }
    known = [row["packages"] for row in rows if "packages" in row]  # not of the first ones
    versions = {
        name: _each(packages[name] for packages in known if name in packages)
        for name in sorted({name for packages in known for name in packages})
    }
    return Origin([shlex.join(["python", *sys.argv])], machine, versions)


def _each(values: Iterable[str]) -> str:
    return ", ".join(sorted(set(values)))


def show(found: Scores, rows: Sequence[Row], arguments: argparse.Namespace) -> None:
    """Write a picture or a page of what was found, or print its tables.

    rows: among which are those of `found`.
    """
    if arguments.picture:
        figure = data_profile_figure(found, [IN_PICTURE.get(one, one) for one in found.labels])
        for text in figure.legends[0].get_texts():
            text.set_fontsize(10)
        arguments.picture.write_bytes(plots.png(figure))
    elif arguments.page:
        runs = longest(rows, found.labels, found.budgets[-1]).values()
        used = [row for row in runs if row["problem"] in found.problems]
        write_scores(found, origin(used), arguments.page)
    else:
        tables = (make(found, list(found.labels)) for make in (totals, by_scene, lowest))
        print(*map(markdown, tables), sep="\n\n")


def main() -> None:
    """Run what is missing, or show what was found."""
    arguments = parse_arguments()
    suite = read(arguments.suite)
    budget = budget_of(suite, arguments.budget)
    try:
        scenes, targets = suite.chosen(arguments.scenes, arguments.targets)
    except OptionError as error:
        sys.exit(str(error))
    optimizers = [label_of(text) for text in arguments.optimizers]
    out = arguments.out or file_of(suite)
    if arguments.table or arguments.picture or arguments.page:
        chosen = [row for row in rows_of(out) if suite.parts(row["problem"])[0] in scenes]
        show(scores(suite, chosen, optimizers, budget), chosen, arguments)
    elif arguments.folder:
        print(take_over(suite, results.read(arguments.folder), out))
    else:
        parts = out.with_suffix(".parts")
        run_missing(
            planned(suite, scenes, optimizers, targets),
            partial(measure, suite, budget, parts),
            out,
            key,
            arguments.part,
            long_enough(budget),
            lambda run: shutil.rmtree(part_of(budget, parts, run), ignore_errors=True),
        )


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--suite", default="image-fitting-v1", choices=suites(), metavar="NAME")
    add(
        "--scenes",
        type=names,
        default=[*CHEAP],
        metavar="A,B",
        help="also povray, san_miguel, beads",
    )
    add("--optimizers", type=names, default=[*OPTIMIZERS], metavar="A,B")
    add("--targets", type=whole(1), metavar="N", help="the first N (default: all)")
    add("--part", default="0/1", metavar="I/N", help="the runs of this process, 0/2 or 1/2")
    add("--out", type=Path, metavar="FILE", help="that of the suite in benchmarks/results")
    add("--from", type=Path, dest="folder", metavar="DIR", help="of fide compare --suite")
    add("--budget", type=int, metavar="N", help="renders: a budget of the suite (its last)")
    add("--table", action="store_true")
    add("--picture", type=Path, metavar="PNG")
    add("--page", type=Path, metavar="HTML", help="page as that of fide compare --suite")
    return parser.parse_args()


if __name__ == "__main__":
    main()
