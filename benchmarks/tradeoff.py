"""What presets and rivals have solved after the same time.

    python benchmarks/tradeoff.py overhead            # processor time of a candidate, by optimizer
    python benchmarks/tradeoff.py table --suites image-fitting-v1,image-fitting-v2

Time is counted: renders until a problem is solved, as `suite.py` has measured them one at a time,
times the cost of a render and what the optimizer itself takes.  The columns are the times in which
the preset "fast" has 500, 1,000 and 2,000 renders.  The problems are those that all optimizers have
finished up to 2,000 renders.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, by_key, finished_by_all, read, run_missing
from suite import file_of, longest

import fide_tasks
from fide_lab import optimizers
from fide_lab.cli.arguments import names
from fide_lab.compare.plan import Configuration
from fide_lab.report.tables import Table, markdown
from fide_lab.suite import read as suite_of

RESULTS = Path(__file__).parent / "results" / "tradeoff.jsonl"
OPTIMIZERS = ("fide", "fide:preset=fast", "fide:preset=accurate", "dfols", "eki")
COSTS = (1, 30, 1000, 10_000)  # milliseconds of a render
RENDERS = (500, 1000, 2000)
CANDIDATES = 1000


def overhead(run: Row) -> Row:
    """Processor time of a candidate of Voronoi at 64 pixels, without its render."""
    task = fide_tasks.make("voronoi", size=64, seed=run["seed"])
    made = Configuration.parse(run["optimizer"])
    settings = {"seed": run["seed"], **made.options}
    opt = optimizers.make(made.name, task.dim, task.target, **settings)
    spent = 0.0
    while opt.evaluations < CANDIDATES:
        began = time.process_time()
        x = opt.ask_ready()
        spent += time.process_time() - began
        images = task.render(x)
        began = time.process_time()
        opt.tell(x, images)
        spent += time.process_time() - began
    return {**run, "ms": round(1e3 * spent / opt.evaluations, 3)}


def key(row: Row) -> tuple[str, int]:
    return row["optimizer"], row["seed"]


def solved(labels: Sequence[str], of: Sequence[str]) -> np.ndarray:
    """Renders (problems, optimizers) until each problem is solved, +inf if not."""
    lines = []
    for name in of:
        suite = suite_of(name)
        found = longest(read(file_of(suite)), labels, RENDERS[-1])
        lines += [
            [found[problem, label]["solved_at"] or np.inf for label in labels]
            for problem in finished_by_all(found, labels)
        ]
    return np.array(lines)


def table(labels: Sequence[str], of: Sequence[str], path: Path) -> str:
    """Solved by these times, for each cost of a render."""
    measured = by_key(read(path), key)
    own = [
        float(np.median([row["ms"] for (name, _), row in measured.items() if name == label]))
        for label in labels
    ]
    at = solved(labels, of)
    rows = []
    for cost in COSTS:
        ends = np.array(RENDERS) * (cost + own[labels.index("fide:preset=fast")])
        for label, each, renders in zip(labels, own, at.T, strict=True):
            counts = [int((renders * (cost + each) <= end).sum()) for end in ends]
            rows.append([label, f"{each:.2f}", f"{cost:,} ms", *map(str, counts)])
    columns = ["", "ms a candidate", "a render", *(f"time of {n:,}" for n in RENDERS)]
    made = Table("", [(name, "") for name in columns], rows)
    return f"{len(at)} problems\n\n{markdown(made)}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["overhead", "table"])
    parser.add_argument("--optimizers", type=names, default=[*OPTIMIZERS], metavar="A,B")
    parser.add_argument("--suites", type=names, default=["image-fitting-v1"], metavar="A,B")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.what == "overhead":
        planned = [{"optimizer": o, "seed": s} for s in range(3) for o in arguments.optimizers]
        run_missing(planned, overhead, arguments.out, key)
    else:
        print(table(arguments.optimizers, arguments.suites, arguments.out))


if __name__ == "__main__":
    main()
