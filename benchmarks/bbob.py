"""The search distribution compared with `cma` and `cmaes` on the 24 BBOB functions, no images.

    pip install ioh==0.3.22
    python benchmarks/bbob.py --out benchmarks/results/bbob.jsonl
    python benchmarks/bbob.py --table benchmarks/results/bbob.jsonl --by-function 10
    python benchmarks/bbob.py --walls 10 --instances 5

The functions are those of Hansen et al. 2009 ("Real-Parameter Black-Box Optimization Benchmarking
2009: Noiseless Functions Definitions", RR-6829), from `ioh`, in the box [-5, 5]^d.  All three
optimizers start at the center with a standard deviation of a sixth of the side, have a population
of 4 + 3 ln d, stay in the box in their own way, and make one search without restarts.  FIDE has
`proposer="none"` and gets no image.  Each run records the evaluations after which f - f* was first
at most 10^1, 10^0, ..., 10^-8.

The table counts the pairs (function, precision) that an optimizer reached in at least half of its
runs, and compares the median evaluations where both did.  "split halves" compares one half of the
instances of `cma` with the other half; this shows the noise.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cma
import cmaes
import numpy as np
from rows import Row, read, run_missing

from fide_plugins.fide import FIDE
from fide_plugins.search import boundary
from fide_plugins.search.cma_es import CMAES, default_popsize
from fide_plugins.types import Float64

OPTIMIZERS = ("fide", "cma", "cmaes")
PRECISIONS = [10.0**power for power in range(1, -9, -1)]
STD = 1 / 6
EVALUATIONS = 1000  # for each parameter
WITH_WALLS = (2, 9, 10, 11, 13, 14)  # functions with one minimum, nowhere at a wall
WALLS = ("reflected", "reflected, no limit", "drawn again", "no box")
RESAMPLED = 1000  # times, for an interval
BLANK = np.zeros((1, 1, 3), np.float32)

Loss = Callable[[Float64], Float64]


class Watch:
    """A function (n, d) -> (n,) of the unit cube, and when it first was below each precision."""

    def __init__(self, function: int, dim: int, instance: int) -> None:
        import ioh

        self._problem = ioh.get_problem(function, instance, dim, ioh.ProblemClass.BBOB)
        self._optimum = self._problem.optimum.y
        self.evaluations = 0
        self.reached: list[int] = []

    def __call__(self, X: Float64) -> Float64:
        values = np.array([self._problem(10 * x - 5) for x in X]) - self._optimum
        for value in values:
            self.evaluations += 1
            while not self.done and value <= PRECISIONS[len(self.reached)]:
                self.reached.append(self.evaluations)
        return np.asarray(values)

    @property
    def done(self) -> bool:
        return len(self.reached) == len(PRECISIONS)


def search(name: str, dim: int, seed: int, loss: Watch, budget: int) -> None:
    """One search to its end, the last precision, or the end of the budget."""
    if name == "fide":
        opt = FIDE(dim, BLANK, proposer="none", restarts="none", seed=seed)
        while loss.evaluations < budget and not loss.done:
            X = opt.ask()
            opt.tell(X, None, loss(X))
    elif name == "cma":
        options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9, "maxfevals": budget}
        es = cma.CMAEvolutionStrategy(dim * [0.5], STD, options)
        while not es.stop() and not loss.done:
            X = es.ask()
            es.tell(X, loss(np.array(X)).tolist())
    else:
        bounds = np.tile([0.0, 1.0], (dim, 1))
        other = cmaes.CMA(np.full(dim, 0.5), STD, bounds=bounds, seed=seed)
        while loss.evaluations < budget and not loss.done and not other.should_stop():
            X = np.array([other.ask() for _ in range(other.population_size)])
            other.tell(list(zip(X, loss(X).tolist(), strict=True)))


def planned(dims: list[int], instances: int) -> Iterator[Row]:
    """All runs, instances outermost."""
    for instance in range(1, instances + 1):
        for dim in dims:
            for function in range(1, 25):
                for name in OPTIMIZERS:
                    yield {
                        "function": function, "dim": dim, "instance": instance, "optimizer": name
                    }  # fmt: skip


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["function"], row["dim"], row["instance"], row["optimizer"]


def run(cell: Row) -> Row:
    """One row."""
    dim, instance = cell["dim"], cell["instance"]
    loss, start = Watch(cell["function"], dim, instance), time.process_time()
    search(cell["optimizer"], dim, instance, loss, EVALUATIONS * dim)
    return {
        **cell,
        "popsize": default_popsize(dim),
        "evaluations": loss.evaluations,
        "reached": loss.reached,
        "cpu_s": round(time.process_time() - start, 2),
    }


def evaluations(rows: list[Row], dim: int, name: str) -> Float64:
    """Evaluations to each precision (24 functions, instances, precisions); infinite for never."""
    runs = {
        (row["function"], row["instance"]): row["reached"]
        for row in rows
        if (row["dim"], row["optimizer"]) == (dim, name)
    }
    instances = sorted({row["instance"] for row in rows if row["dim"] == dim})
    reached = np.full((24, len(instances), len(PRECISIONS)), np.inf)
    for function, of_instances in enumerate(reached, 1):
        for instance, of_precisions in zip(instances, of_instances, strict=True):
            found = runs.get((function, instance), [])
            of_precisions[: len(found)] = found
    return reached


def medians(reached: Float64) -> Float64:
    """Over instances, (functions, precisions); finite where at least half of the runs got there."""
    middle = (reached.shape[1] - 1) // 2  # the lower of two
    return np.asarray(np.sort(reached, axis=1)[:, middle])


def log_ratio(a: Float64, b: Float64) -> float:
    """Mean over functions of log(a / b), where both (functions, precisions) are finite."""
    both = np.isfinite(a) & np.isfinite(b)
    logs = np.where(both, np.log(np.where(both, a, 1.0) / np.where(both, b, 1.0)), 0.0)
    count = both.sum(axis=1)
    each = logs.sum(axis=1)[count > 0] / count[count > 0]
    return float(each.mean()) if len(each) else np.nan


def compared(a: Float64, b: Float64, rng: np.random.Generator, paired: bool = True) -> str:
    """Geometric mean of a / b over functions where both have medians, with a 95 % interval.

    a, b: see `evaluations`.  The interval is by bootstrap over functions, each of which counts
    once, and over instances; of both the same ones if they are paired.
    """
    means = []
    for _ in range(RESAMPLED):
        functions = rng.integers(24, size=24)
        left = rng.integers(a.shape[1], size=a.shape[1])
        right = left if paired else rng.integers(b.shape[1], size=b.shape[1])
        chosen = medians(a[functions][:, left]), medians(b[functions][:, right])
        means.append(log_ratio(*chosen))
    low, high = np.exp(np.nanquantile(means, [0.025, 0.975]))
    return f"{np.exp(log_ratio(medians(a), medians(b))):.2f} ({low:.2f} to {high:.2f})"


def table(rows: list[Row]) -> str:
    """One line an optimizer and dimension."""
    rng = np.random.default_rng(0)
    lines = [
        "| d | optimizer | runs | reached, of 240 | evaluations / those of `cma` | / of `cmaes` |",
        "|---|---|---|---|---|---|",
    ]
    for dim in sorted({row["dim"] for row in rows}):
        of = {name: evaluations(rows, dim, name) for name in OPTIMIZERS}
        for name in OPTIMIZERS:
            runs = sum(row["dim"] == dim and row["optimizer"] == name for row in rows)
            cells = ["" if name == o else compared(of[name], of[o], rng) for o in OPTIMIZERS[1:]]
            solved = int(np.isfinite(medians(of[name])).sum())
            lines.append(f"| {dim} | {name} | {runs} | {solved} | {cells[0]} | {cells[1]} |")
        odd, even = (of["cma"][:, first::2] for first in (0, 1))
        solved_in = " and ".join(str(int(np.isfinite(medians(h)).sum())) for h in (odd, even))
        noise = compared(odd, even, rng, paired=False)
        lines.append(f"| {dim} | `cma`, split halves | | {solved_in} | {noise} | |")
    return "\n".join(lines)


def by_function(rows: list[Row], dim: int) -> str:
    """Ratio of FIDE's evaluations to those of the others, function by function."""
    of = {name: medians(evaluations(rows, dim, name)) for name in OPTIMIZERS}
    lines = ["| function | / `cma` | precisions | / `cmaes` | precisions |", "|---" * 5 + "|"]
    for i in range(24):
        cells = []
        for other in OPTIMIZERS[1:]:
            a, b = of["fide"][i : i + 1], of[other][i : i + 1]
            cells += [
                f"{np.exp(log_ratio(a, b)):.2f}",
                f"{(np.isfinite(a) & np.isfinite(b)).sum()}",
            ]
        lines.append(f"| {i + 1} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def walls(dim: int, instances: int) -> str:
    """Evaluations to the last precision with each way of keeping to the box, and without a box."""
    lines = [f"| function | {' | '.join(WALLS)} |", "|---" * (len(WALLS) + 1) + "|"]
    for function in WITH_WALLS:
        cells = []
        for how in WALLS:
            found = [near_walls(function, dim, i, how) for i in range(1, instances + 1)]
            reached = [evaluations for evaluations in found if evaluations]
            cells.append(f"{np.exp(np.mean(np.log(reached))):,.0f} ({len(reached)})")
        lines.append(f"| {function} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def near_walls(function: int, dim: int, instance: int, how: str) -> int | None:
    """Evaluations to the last precision, None if it was not reached; see `walls`."""
    loss, rng = Watch(function, dim, instance), np.random.default_rng(instance)
    limit = how != "reflected, no limit"
    search = CMAES(np.full(dim, 0.5), STD, default_popsize(dim), widest=1.0 if limit else np.inf)
    while loss.evaluations < EVALUATIONS * dim and not loss.done:
        z = search.sample(search.popsize, rng)
        for _ in range(30 if how == "drawn again" else 0):
            outside = ((z < 0) | (z > 1)).any(axis=1)
            if outside.any():
                z[outside] = search.sample(int(outside.sum()), rng)
        losses = loss(z if how == "no box" else boundary.into(z))
        search.tell(z, losses, np.zeros(len(z), bool))
    return loss.reached[-1] if loss.done else None


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--dims", nargs="+", type=int, default=[5, 10])
    parser.add_argument("--instances", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path("runs/bbob.jsonl"))
    parser.add_argument("--table", type=Path)
    parser.add_argument("--walls", type=int, metavar="DIM")
    parser.add_argument("--by-function", nargs="+", type=int, default=[], metavar="DIM")
    arguments = parser.parse_args()
    if arguments.walls:
        print(walls(arguments.walls, arguments.instances))
        return
    if arguments.table:
        rows = read(arguments.table)
        print(table(rows))
        for dim in arguments.by_function:
            print(by_function(rows, dim))
        return
    run_missing(planned(arguments.dims, arguments.instances), run, arguments.out, key)


if __name__ == "__main__":
    main()
