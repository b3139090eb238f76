"""The search distribution beside `cma` and `cmaes`, on the 24 BBOB functions, by losses alone.

    pip install ioh==0.3.22
    python benchmarks/bbob.py --out benchmarks/results/bbob.jsonl
    python benchmarks/bbob.py --table benchmarks/results/bbob.jsonl

The functions are those of Hansen et al. 2009 ("Real-Parameter Black-Box Optimization Benchmarking
2009: Noiseless Functions Definitions", RR-6829), made by `ioh`, in the box [-5, 5]^d.  All three
begin in its center with a sixth of its side, have a population of 4 + 3 ln d, keep to the box in
their own way, and make one search without restarts.  FIDE has `proposer="none"`, and is told no
image.  Noted are the evaluations after which f - f* first was at most 10^1, 10^0, ..., 10^-8.

The table counts, over functions and precisions, the pairs (function, precision) that an optimizer
reached in at least half of its runs, and compares the median evaluations where both did.  "split
halves" compares `cma` with itself, one half of the instances with the other: that is the noise.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cma
import cmaes
import numpy as np

from fide_plugins.fide import FIDE
from fide_plugins.points import Float64
from fide_plugins.search.cma_es import default_popsize

OPTIMIZERS = ("fide", "cma", "cmaes")
PRECISIONS = [10.0**power for power in range(1, -9, -1)]
STD = 1 / 6
EVALUATIONS = 1000  # for each parameter
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
        return values

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


def run(name: str, function: int, dim: int, instance: int) -> dict[str, Any]:
    """One row."""
    loss, start = Watch(function, dim, instance), time.process_time()
    search(name, dim, instance, loss, EVALUATIONS * dim)
    return {
        "function": function, "dim": dim, "instance": instance, "optimizer": name,
        "popsize": default_popsize(dim), "evaluations": loss.evaluations, "reached": loss.reached,
        "cpu_s": round(time.process_time() - start, 2),
    }  # fmt: skip


def medians(rows: list[dict[str, Any]], dim: int, name: str, odd: int | None) -> Float64:
    """Median evaluations (functions, precisions); infinite where fewer than half of runs did."""
    table = []
    for function in range(1, 25):
        runs = [
            row["reached"] + [np.inf] * (len(PRECISIONS) - len(row["reached"]))
            for row in rows
            if (row["function"], row["dim"], row["optimizer"]) == (function, dim, name)
            and odd in (None, row["instance"] % 2)
        ]
        middle = (len(runs) - 1) // 2  # the lower of two: reached by at least half
        table.append(np.sort(runs, axis=0)[middle] if runs else np.full(len(PRECISIONS), np.inf))
    return np.array(table)


def compared(a: Float64, b: Float64, rng: np.random.Generator) -> str:
    """Geometric mean of a / b over functions where both are finite, with a 95 % interval.

    The interval is by bootstrap over functions, each of which counts once.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.where(np.isfinite(a) & np.isfinite(b), np.log(a / b), np.nan)
    each = np.array([np.nanmean(row) for row in logs if np.isfinite(row).any()])
    means = rng.choice(each, (4000, len(each))).mean(axis=1)
    low, high = np.exp(np.quantile(means, [0.025, 0.975]))
    return f"{np.exp(each.mean()):.2f} ({low:.2f} to {high:.2f})"


def table(rows: list[dict[str, Any]]) -> str:
    """One line an optimizer and dimension."""
    rng = np.random.default_rng(0)
    lines = [
        "| d | optimizer | runs | reached, of 240 | evaluations / those of `cma` | / of `cmaes` |",
        "|---|---|---|---|---|---|",
    ]
    for dim in sorted({row["dim"] for row in rows}):
        of = {name: medians(rows, dim, name, None) for name in OPTIMIZERS}
        for name in OPTIMIZERS:
            runs = sum(row["dim"] == dim and row["optimizer"] == name for row in rows)
            cells = ["" if name == o else compared(of[name], of[o], rng) for o in OPTIMIZERS[1:]]
            solved = int(np.isfinite(of[name]).sum())
            lines.append(f"| {dim} | {name} | {runs} | {solved} | {cells[0]} | {cells[1]} |")
        halves = [medians(rows, dim, "cma", odd) for odd in (1, 0)]
        solved_in = " and ".join(str(int(np.isfinite(half).sum())) for half in halves)
        noise = compared(*halves, rng)
        lines.append(f"| {dim} | `cma`, split halves | | {solved_in} | {noise} | |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--dims", nargs="+", type=int, default=[5, 10])
    parser.add_argument("--instances", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path("runs/bbob.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    out = arguments.table or arguments.out
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    if arguments.table:
        print(table(rows))
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["function"], r["dim"], r["instance"], r["optimizer"]) for r in rows}
    for instance in range(1, arguments.instances + 1):
        for dim in arguments.dims:
            for function in range(1, 25):
                for name in OPTIMIZERS:
                    if (function, dim, instance, name) in done:
                        continue
                    row = run(name, function, dim, instance)
                    with out.open("a") as file:
                        file.write(json.dumps(row) + "\n")
        print(f"instance {instance} done", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
