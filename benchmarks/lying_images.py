"""What misleading images cost: evaluations to a target loss, compared with a search without images.

    python benchmarks/lying_images.py --out runs/lying.jsonl
    python benchmarks/lying_images.py --table runs/lying.jsonl

Problems: a sphere and Rosenbrock's function of ten parameters, with images that show all ten; and
the task voronoi, 8 cells, mean squared error.  Images are those of the renderer ("honest"), noise,
constant, those of other candidates, or true images with a target that no parameters reach
("unreachable": noise).  In the last problem of voronoi the losses are also those of such a target.
All configurations have the same seeds; `without` gets losses only.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

CONFIGURATIONS = ("without", "noise", "constant", "others", "unreachable", "honest")
DIM, SIZE = 10, 32


class Problem(NamedTuple):
    """dim, target (H, W, 3), loss of candidates and images, renderer, budget, loss to reach."""

    dim: int
    target: Float32
    loss: Callable[[Float64, Float32], Float64]
    render: Callable[[Float64], Float32]
    budget: int
    goal: float


def blurred(X: Float64) -> Float32:
    """Images (n, 32, 32, 3) that show all of X (n, 10), smoothly and not linearly."""
    weights = 2 * np.random.default_rng(3).standard_normal((DIM, SIZE * SIZE * 3))
    images: Float32 = (1 / (1 + np.exp((0.5 - X) @ weights))).astype(np.float32)
    return images.reshape(-1, SIZE, SIZE, 3)


def sphere() -> Problem:
    """Sum (x - answer)^2."""
    answer = np.random.default_rng(7).uniform(0.2, 0.8, DIM)
    target = blurred(answer[None])[0]
    return Problem(DIM, target, lambda X, _: np.square(X - answer).sum(axis=1), blurred, 2500, 1e-8)


def rosenbrock() -> Problem:
    """Of u = 4 x - 2, so in [-2, 2]; the answer is x = 3/4."""

    def loss(X: Float64, _: Float32) -> Float64:
        u = 4 * X - 2
        steep, flat = u[:, 1:] - u[:, :-1] ** 2, 1 - u[:, :-1]
        values: Float64 = (100 * steep**2 + flat**2).sum(axis=1)
        return values

    return Problem(DIM, blurred(np.full((1, DIM), 0.75))[0], loss, blurred, 9000, 1e-6)


def voronoi(unreachable: bool) -> Problem:
    """Eight cells, 48 x 48; the goal is what the search without images reaches in most runs."""
    task = fide_tasks.make("voronoi", size=48)
    target = task.target
    if unreachable:
        target = np.random.default_rng(5).random(target.shape, np.float32)

    def loss(X: Float64, images: Float32) -> Float64:
        values: Float64 = np.square(images.astype(np.float64) - target).mean(axis=(1, 2, 3))
        return values

    goal = 0.085 if unreachable else 0.02
    return Problem(task.dim, target, loss, task.render, 5000, goal)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "sphere": sphere,
    "rosenbrock": rosenbrock,
    "voronoi": lambda: voronoi(False),
    "voronoi, unreachable target": lambda: voronoi(True),
}


def shown(configuration: str, rendered: Float32, problem: Problem, rng: np.random.Generator) -> Any:
    """What is told of rendered images."""
    if configuration == "without":
        return None
    if configuration == "noise":
        return rng.random(rendered.shape, np.float32)
    if configuration == "constant":
        return np.full_like(rendered, 0.5)
    if configuration == "others":
        return problem.render(rng.random((len(rendered), problem.dim)))
    return rendered


def planned(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in range(arguments.seeds):
        for name in arguments.problems:
            for configuration in arguments.configurations:
                needless = name.endswith("target") and configuration == "unreachable"
                if not needless:
                    yield {"problem": name, "configuration": configuration, "seed": seed}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["problem"], row["configuration"], row["seed"]


def run(planned_run: Row) -> Row:
    """One run, to the goal or to the end of its budget."""
    configuration, seed = planned_run["configuration"], planned_run["seed"]
    problem, rng = PROBLEMS[planned_run["problem"]](), np.random.default_rng(seed)
    target = problem.target
    if configuration == "unreachable":
        target = np.random.default_rng(5).random(target.shape, np.float32)
    opt, start = FIDE(problem.dim, target, seed=seed), time.process_time()
    while opt.evaluations < problem.budget:
        X = opt.ask()
        rendered = problem.render(X)
        opt.tell(X, shown(configuration, rendered, problem, rng), problem.loss(X, rendered))
        if opt.best is not None and opt.best.loss <= problem.goal:
            break
    best = np.inf if opt.best is None else opt.best.loss
    reached = opt.best.evaluation + 1 if opt.best is not None and best <= problem.goal else None
    seconds = time.process_time() - start
    return {
        **planned_run,
        "goal": problem.goal,
        "reached": reached,
        "best": best,
        "searches": opt.state.searches,
        "cpu_s": round(seconds, 2),
    }


def table(rows: list[Row]) -> str:
    """Median evaluations to the goal, and the median ratio to the same seed without images."""
    lines = [
        "| | goal | seeds | " + " | ".join(CONFIGURATIONS) + " |",
        "|---" * (len(CONFIGURATIONS) + 3) + "|",
    ]
    for name in PROBLEMS:
        runs = {
            configuration: reached(rows, name, configuration) for configuration in CONFIGURATIONS
        }
        goals = {row["goal"] for row in rows if row["problem"] == name}
        cells = [cell(runs[configuration], runs["without"]) for configuration in CONFIGURATIONS]
        head = f"| {name} | {max(goals, default=0):g} | {len(runs['without'])} | "
        lines.append(head + " | ".join(cells) + " |")
    return "\n".join(lines)


def reached(rows: list[Row], name: str, configuration: str) -> dict[int, float]:
    """Evaluations to the goal of each seed; infinite where it was not reached."""
    mine = [row for row in rows if (row["problem"], row["configuration"]) == (name, configuration)]
    return {row["seed"]: row["reached"] or np.inf for row in mine}


def cell(runs: dict[int, float], without: dict[int, float]) -> str:
    """Median, and the median ratio over pairs of which not both failed."""
    middle = statistics.median(runs.values()) if runs else np.inf
    pairs = [(runs[s], without[s]) for s in runs if s in without]
    ratios = [a / b for a, b in pairs if min(a, b) < np.inf]
    return f"{middle:,.0f} ({statistics.median(ratios):.2f})" if middle < np.inf else "-"


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS))
    parser.add_argument("--configurations", nargs="+", default=list(CONFIGURATIONS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("runs/lying.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(planned(arguments), run, arguments.out, key)


if __name__ == "__main__":
    main()
