"""Best value against evaluations of the baselines, on functions of 10 and 20 parameters.

    python benchmarks/baselines.py --out benchmarks/results/baselines.jsonl
    python benchmarks/baselines.py --configurations DiBO --functions ackley --dims 10 --seeds 1 ...
    python benchmarks/baselines.py --table benchmarks/results/baselines.jsonl

Ackley, Rastrigin, Levy and Rosenbrock in the boxes of the DiBO paper, scaled to the unit cube.  The
seed shifts each function by up to a fifth of the box in each parameter, in the same way for all
optimizers.  Without this shift the start in the center is the answer for some functions.  Every run
(function, dimension, optimizer, seed) is one line of the output file.  A second call does the
missing runs and continues an interrupted run of DiBO.  One thread per process; `--part i/n` divides
the runs among n processes.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from quality import run_configurations
from rows import Row, read

from fide_lab import optimizers
from fide_lab.baselines.base import Baseline
from fide_lab.baselines.zerograds import ZeroGrads
from fide_plugins.recording.record import best_so_far
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float64

MARKS = (100, 300, 600, 1000, 2000, 5000)
SHIFT = 0.2  # of the box
SMALL_DIBO = {
    "width": 128,
    "proxy_width": 64,
    "batch": 64,
    "proposals": 2,
    "precision": "single",
    "schedule": "paper",
}
"""Smaller networks and fewer samples than the defaults, which take a quarter of an hour a round.

`schedule` is what it was when the runs in results/baselines.jsonl were made.
"""

CONFIGURATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "random": ("random", {}),
    "CMA-ES, default k": ("cma", {}),
    "CMA-ES, k = 50": ("cma", {"popsize": 50}),
    "dual annealing": ("dual-annealing", {}),
    "ZeroGrads": ("zerograds", {}),
    "ZeroGrads, former rates": ("zerograds", {"learning_rate": 2e-3, "proxy_rate": 3e-3}),
    "ZeroGrads, naive": ("naive zerograds", {"learning_rate": 5e-4, "proxy_rate": 1e-3}),
    "DiBO": ("dibo", SMALL_DIBO),
    "DiBO, exact likelihood": ("dibo", {**SMALL_DIBO, "likelihood": "exact"}),
    "DiBO, authors' noise": ("dibo", {**SMALL_DIBO, "schedule": "authors"}),
    "DiBO, naive": ("dibo", {**SMALL_DIBO, "proposals": 1, "search_epochs": 0}),
    "Optuna TPE": ("optuna:TPESampler", {}),
}
SHOWN = [name for name in CONFIGURATIONS if name != "Optuna TPE"]
RATES = [(rate, 1e-3) for rate in (5e-4, 2e-3, 5e-3, 1e-2, 2e-2)]
RATES += [(5e-4, 3e-3), (2e-3, 3e-3), (2e-3, 1e-2), (5e-3, 1e-2)]
CONFIGURATIONS |= {
    f"ZeroGrads, rates {rate:g} and {proxy:g}": (
        "zerograds",
        {"learning_rate": rate, "proxy_rate": proxy},
    )
    for rate, proxy in RATES
}
"""Of the parameter and of the network, to choose from."""
SHORT = ("DiBO", "DiBO, exact likelihood", "DiBO, authors' noise", "DiBO, naive", "Optuna TPE")
BUDGETS = dict.fromkeys(SHORT, 600)
BUDGET = 5000


class NaiveZeroGrads(ZeroGrads):
    """The published steps, but the best is looked for among the scattered points alone.

    Losses are learned as they are, whatever their size.  The first of these points takes the place
    of the parameter, so it is evaluated, and learned from, twice.
    """

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **{**options, "scale": "none"})

    def _sample(self) -> Float64:
        points = super()._sample()
        points[-1] = points[0]  # the parameter itself is not evaluated
        return points


optimizers.register("naive zerograds", NaiveZeroGrads)


def ackley(y: Float64) -> Float64:
    """Ackley's function, its minimum 0 at 0."""
    a = -20 * np.exp(-0.2 * np.sqrt((y**2).mean(axis=1)))
    value: Float64 = a - np.exp(np.cos(2 * np.pi * y).mean(axis=1)) + 20 + np.e
    return value


def rastrigin(y: Float64) -> Float64:
    """Rastrigin's function, its minimum 0 at 0."""
    value: Float64 = (10 + y**2 - 10 * np.cos(2 * np.pi * y)).sum(axis=1)
    return value


def levy(y: Float64) -> Float64:
    """Levy's function, its minimum 0 at 1."""
    w = 1 + (y - 1) / 4
    first, inner, last = w[:, 0], w[:, :-1], w[:, -1]
    middle = ((inner - 1) ** 2 * (1 + 10 * np.sin(np.pi * inner + 1) ** 2)).sum(axis=1)
    end = (last - 1) ** 2 * (1 + np.sin(2 * np.pi * last) ** 2)
    value: Float64 = np.sin(np.pi * first) ** 2 + middle + end
    return value


def rosenbrock(y: Float64) -> Float64:
    """Rosenbrock's function, its minimum 0 at 1."""
    value: Float64 = (100 * (y[:, 1:] - y[:, :-1] ** 2) ** 2 + (1 - y[:, :-1]) ** 2).sum(axis=1)
    return value


FUNCTIONS: dict[str, tuple[Callable[[Float64], Float64], float, float]] = {
    "ackley": (ackley, -5.0, 10.0),
    "rastrigin": (rastrigin, -5.0, 5.0),
    "levy": (levy, -10.0, 10.0),
    "rosenbrock": (rosenbrock, -5.0, 10.0),
}


def in_the_unit_cube(name: str, dim: int, seed: int) -> Callable[[Float64], Float64]:
    """Function of that name over [0, 1]^dim, shifted by the seed."""
    function, low, high = FUNCTIONS[name]
    shift = np.random.default_rng([seed, dim]).uniform(-SHIFT, SHIFT, dim)
    return lambda X: function(low + (high - low) * (X - shift))


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(*arguments.table), arguments.configurations))
        return

    def run(cell: Row, optimizer: str, options: dict[str, Any]) -> Row:
        return measure(cell, optimizer, options, arguments.out.with_suffix(".parts"))

    run_configurations(grid(arguments), CONFIGURATIONS, arguments.out, arguments.part, run)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--configurations", nargs="+", default=SHOWN, metavar="CONFIGURATION")
    parser.add_argument("--functions", nargs="+", default=list(FUNCTIONS))
    parser.add_argument("--dims", nargs="+", type=int, default=[10, 20])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", type=int, default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/baselines.jsonl"))
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", type=Path, nargs="+")
    return parser.parse_args()


def grid(arguments: argparse.Namespace) -> Iterator[Row]:
    """All cells, seeds outermost; `size` is the dimension."""
    for seed in range(arguments.seeds):
        for dim in arguments.dims:
            for name in arguments.functions:
                for configuration in arguments.configurations:
                    budget = arguments.budget or BUDGETS.get(configuration, BUDGET)
                    cell = {
                        "task": name,
                        "target": seed,
                        "configuration": configuration,
                        "seed": seed,
                    }
                    yield {**cell, "size": dim, "budget": budget}


def measure(cell: Row, name: str, options: dict[str, Any], parts: Path) -> Row:
    """One run, saved after every round if it is a slow one; its best value at every mark."""
    function = in_the_unit_cube(cell["task"], cell["size"], cell["target"])
    parts.mkdir(parents=True, exist_ok=True)
    place = parts / "-".join(str(cell[key]) for key in ("task", "size", "configuration", "seed"))
    opt, losses, seconds = begin(name, options, cell, place)
    while len(losses) < cell["budget"]:
        start = time.process_time()
        X = opt.ask()
        values = function(X)
        opt.tell(X, losses=values)
        losses = np.concatenate([losses, values])
        seconds += time.process_time() - start
        if name == "dibo":
            opt.save(place.with_suffix(".ckpt"))
            checkpoint.write(place, "losses", {"losses": losses, "seconds": seconds})
    best = best_so_far(losses)
    marks = {m for m in MARKS if m <= cell["budget"]} | {cell["budget"]}
    place.unlink(missing_ok=True)
    place.with_suffix(".ckpt").unlink(missing_ok=True)
    return {
        **cell,
        "best": {str(m): float(best[m - 1]) for m in sorted(marks)},
        "cpu_s": round(seconds, 2),
    }


def begin(
    name: str, options: dict[str, Any], cell: Row, place: Path
) -> tuple[Baseline, Float64, float]:
    """A new optimizer, or one that was interrupted, with its losses and seconds so far."""
    if place.exists():
        done = checkpoint.read(place, "losses")
        opt = optimizers.load(name, place.with_suffix(".ckpt"))
        if isinstance(opt, Baseline) and opt.evaluations == len(done["losses"]):
            return opt, done["losses"], float(done["seconds"])
    opt = optimizers.make(name, cell["size"], seed=cell["seed"], **options)
    if not isinstance(opt, Baseline):
        raise TypeError(f"{name} is no baseline")
    return opt, np.empty(0), 0.0


def table(rows: list[Row], chosen: list[str]) -> str:
    """Medians over seeds of the chosen configurations, in Markdown."""
    lines: list[str] = []
    for dim in sorted({row["size"] for row in rows}):
        for name in FUNCTIONS:
            mine = [row for row in rows if (row["task"], row["size"]) == (name, dim)]
            if not mine:
                continue
            lines += [f"### {name.capitalize()}, {dim} parameters", ""]
            head = " | ".join(f"{mark:,}" for mark in MARKS)
            lines += [f"| | runs | {head} | CPU s |", "|---" * (len(MARKS) + 3) + "|"]
            configurations = [
                configuration
                for configuration in chosen
                if any(row["configuration"] == configuration for row in mine)
            ]
            lines += [
                line(configuration, [row for row in mine if row["configuration"] == configuration])
                for configuration in configurations
            ]
            lines.append("")
    return "\n".join(lines)


def line(configuration: str, rows: list[Row]) -> str:
    """One configuration."""
    cells = []
    for mark in map(str, MARKS):
        reached = [row["best"][mark] for row in rows if mark in row["best"]]
        cells.append(f"{statistics.median(reached):.3g}" if reached else "")
    seconds = statistics.median(row["cpu_s"] for row in rows)
    return f"| {configuration} | {len(rows)} | {' | '.join(cells)} | {seconds:.1f} |"


if __name__ == "__main__":
    main()
