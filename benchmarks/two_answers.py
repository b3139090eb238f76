"""Whether both orders of two cells are among the solutions, each with probability one half.

    python benchmarks/two_answers.py --out benchmarks/results/two_answers.jsonl
    python benchmarks/two_answers.py --table benchmarks/results/two_answers.jsonl

The scene of the paper's Fig. 2: the distance from the nearer of two centers, which says nothing of
their order (task `voronoi`, variant "distance", 32 pixels).  One model learns 4,000 renders; then
each picture is searched from its hypotheses.  `groups=[]` says that no blocks are exchangeable, so
that the two orders are two answers.  An answer is found if each coordinate is within 0.02.  Every
picture is one line of the output file; a second call does what is missing.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from functools import lru_cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from moves import span
from numpy.typing import NDArray
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins import FIDE, learn

SIZE, RENDERS, PASSES, BUDGET = 32, 4000, 5, 1000
NEAR = 0.02


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", type=span, default=range(100, 120), metavar="A-B")
    parser.add_argument("--out", type=Path, default=Path("runs/two_answers.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        file, start = f"{folder}/cells.fide", time.process_time()
        learn(render, make(0).dim, renders=RENDERS, passes=PASSES, size=SIZE, out=file, seed=0)
        seconds = round(time.process_time() - start, 1)
        planned = ({"target": target} for target in arguments.targets)
        run_missing(
            planned,
            lambda picture: {
                **picture,
                "learning_cpu_s": seconds,
                **measure(picture["target"], file),
            },
            arguments.out,
            lambda row: row["target"],
        )


def render(x: NDArray[np.float64]) -> NDArray[np.float32]:
    """Image (SIZE, SIZE, 3) of two centers (4,)."""
    image: NDArray[np.float32] = make(0).render(x[None])[0]
    return image


@lru_cache
def make(target: int) -> fide_tasks.Task:
    """Scene with that target."""
    return fide_tasks.make("voronoi", SIZE, target, variant="distance")


def measure(target: int, model: str) -> Row:
    """Probability of the answer at each order of the cells; None where it is no solution."""
    task = make(target)
    opt = FIDE(task.dim, task.target, learned=model, groups=[], seed=0)
    while opt.evaluations < BUDGET:
        X = opt.ask()
        opt.tell(X, task.render(X))
    assert task.x_star is not None
    found = opt.solutions(5)
    chances: list[float | None] = []
    for order in (task.x_star, np.roll(task.x_star, 2)):
        near = [one for one in found if np.abs(one.x - order).max() <= NEAR]
        chances.append(sum(one.probability or 0.0 for one in near) if near else None)
    return {"probabilities": chances, "losses": [one.loss for one in found]}


def table(rows: list[Row]) -> str:
    """Pictures with both answers, and their probabilities, in Markdown."""
    both = [row["probabilities"] for row in rows if None not in row["probabilities"]]
    even = sum(max(abs(p - 0.5) for p in pair) <= 0.1 for pair in both)
    least = min((min(pair) for pair in both), default=float("nan"))
    most = max((max(pair) for pair in both), default=float("nan"))
    return (
        "| pictures | both answers in `solutions()` | both 0.5 +- 0.1 | probabilities |\n"
        "|---:|---:|---:|---|\n"
        f"| {len(rows)} | {len(both)} | {even} | {least:.2f} to {most:.2f} |"
    )


if __name__ == "__main__":
    main()
