"""`fit` with several workers: what it costs, how busy they are, what it finds.

    python benchmarks/fit_workers.py loss --seeds 0-39 --out runs/fit_workers.jsonl
    python benchmarks/fit_workers.py table --out runs/fit_workers.jsonl
    python benchmarks/fit_workers.py busy
    python benchmarks/fit_workers.py cost

loss: a scene (Voronoi: 8 cells, 40 parameters), 64 px, 1,000 renders by one worker, by eight, and
by whole generations, each told when it is complete.  Eight workers are simulated: each
render takes 100 ms of a clock of their own, give or take a tenth, so results arrive in an order as
of real workers, without waiting.  Every run is one line of the output file; a second call does what
is missing.  --cma: with nothing proposed and no restarts.
busy: eight worker processes and a renderer of 100 ms.
cost: milliseconds of CPU time of a candidate, by hand and by `fit`, the least of several
repetitions.
"""

from __future__ import annotations

import argparse
import heapq
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins import FIDE, fit
from fide_plugins.recording.record import best_so_far

BUDGET, WORKERS, SECONDS = 1000, 8, 0.1
MARKS = (250, 500, 1000)
GENERATIONS = 0  # in the place of a number of workers
NAMES = {WORKERS: "eight workers", GENERATIONS: "whole generations"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["loss", "table", "busy", "cost"])
    parser.add_argument("--seeds", default="0-9")
    parser.add_argument("--scene", default="voronoi")
    parser.add_argument("--cma", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("runs/fit_workers.jsonl"))
    arguments = parser.parse_args()
    if arguments.what == "loss":
        first, last = map(int, arguments.seeds.split("-"))
        kind = arguments.scene + (" cma" if arguments.cma else "")
        run_missing(
            cells(range(first, last + 1), kind),
            lambda cell: {**cell, "losses": losses(**cell)},
            arguments.out,
            key,
        )
    elif arguments.what == "busy":
        busy()
    elif arguments.what == "cost":
        cost()
    else:
        print(tables(read(arguments.out)))


# -- loss ------------------------------------------------------------------------------------------


class SimulatedWorkers(Executor):
    """Renders at once, and hands out a result when all workers are taken: the one due first.

    budget: renders that are submitted in all; with the last one all others are handed out, too.
    """

    def __init__(self, number: int, seed: int, budget: int) -> None:
        self._number, self._rng, self._budget = number, np.random.default_rng(seed), budget
        self._now, self._count = 0.0, 0
        self._running: list[tuple[float, int, Future[Any], Any]] = []

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        due = self._now + SECONDS * self._rng.uniform(0.9, 1.1)
        heapq.heappush(self._running, (due, self._count, future, function(*args, **kwargs)))
        self._count += 1
        least = self._number if self._count < self._budget else 1
        while len(self._running) >= least:
            self._now, _, first, result = heapq.heappop(self._running)
            first.set_result(result)
        return future


def cells(seeds: range, kind: str) -> Iterator[Row]:
    for seed in seeds:
        for workers in (1, WORKERS, GENERATIONS):
            yield {"kind": kind, "seed": seed, "workers": workers}


def key(row: Row) -> tuple[Any, ...]:
    return kind_of(row), row["seed"], row["workers"]


def kind_of(row: Row) -> str:
    return str(row.get("kind", "voronoi"))


def losses(kind: str, seed: int, workers: int) -> dict[str, float]:
    """Best losses of one run; target and optimizer have the same seed."""
    scene, *cma = kind.split()
    task = fide_tasks.make(scene, size=64, seed=seed)
    options: dict[str, Any] = {"proposer": "none", "restarts": "none"} if cma else {}

    def render(x: Any) -> Any:
        return task.render(x[None])[0]

    if workers == GENERATIONS:
        opt, told = FIDE(task.dim, task.target, seed=seed, **options), np.empty(0)
        while len(told) < BUDGET:
            X = opt.ask()
            told = np.append(told, opt.tell(X, task.render(X)))
        curve = best_so_far(told)
    else:
        several = {"workers": workers, "executor": SimulatedWorkers(workers, seed, BUDGET)}
        options |= {"workers": 0} if workers == 1 else several
        result = fit(render, task.target, task.dim, BUDGET, seed=seed, progress=False, **options)
        curve = result.curve[:, 1]
    return {str(mark): float(curve[mark - 1]) for mark in MARKS}


def tables(rows: list[Row]) -> str:
    """Eight workers, then whole generations, beside one worker, for each kind of run."""
    parts = []
    for kind in sorted({kind_of(row) for row in rows}):
        own = [row for row in rows if kind_of(row) == kind]
        parts += [f"{kind}, {name}: {table(own, w)}" for w, name in NAMES.items()]
    return "\n\n".join(parts)


def table(rows: list[Row], others: int) -> str:
    by = {(row["seed"], row["workers"]): row["losses"] for row in rows}
    seeds = sorted({s for s, w in by if w == 1} & {s for s, w in by if w == others})
    if len(seeds) < 2:
        return "fewer than two seeds"
    lines = [f"{len(seeds)} seeds", "| renders | one worker | these | ratio | 95 % of it |"]
    for mark in map(str, MARKS):
        one, other = (np.log([by[s, w][mark] for s in seeds]) for w in (1, others))
        ratios = other - one
        spread = 1.96 * ratios.std(ddof=1) / len(seeds) ** 0.5
        numbers = one.mean(), other.mean(), ratios.mean(), ratios.mean() - spread
        cells = [f"{np.exp(number):.3g}" for number in (*numbers, ratios.mean() + spread)]
        lines.append(f"| {mark} | {' | '.join(cells[:3])} | {cells[3]} to {cells[4]} |")
    return "\n".join(lines)


# -- time ------------------------------------------------------------------------------------------


def busy() -> None:
    """Print the fraction of the time that workers render, without and with their start."""
    target = np.full((64, 64, 3), 0.5)

    def render(x: Any) -> Any:
        import time

        import numpy as np

        start = time.perf_counter()
        image = np.full((64, 64, 3), x.mean())
        time.sleep(0.1 - (time.perf_counter() - start))
        return image

    times: list[float] = []
    result = fit(
        render, target, 40, BUDGET, workers=WORKERS, seed=0, progress=False,
        callbacks=lambda event: times.append(time.perf_counter()),
    )  # fmt: skip
    rate = (len(times) - 100) / (times[-1] - times[99])
    print(f"busy {rate * SECONDS / WORKERS:.1%} after the first 100 renders, all {result.busy:.1%}")


def cost() -> None:
    """Print CPU milliseconds a candidate."""
    task = fide_tasks.make("voronoi", size=64, seed=0)
    image, number = task.render(np.full((1, task.dim), 0.5))[0], 400

    def by_hand(seed: int) -> None:
        opt = FIDE(task.dim, task.target, seed=seed)
        for _ in range(number):
            x = opt.ask(1)
            opt.tell(x, [image])

    def by_fit(seed: int) -> None:
        fit(lambda x: image, task.target, task.dim, number, workers=0, seed=seed, progress=False)

    least = {by_hand: np.inf, by_fit: np.inf}
    for _ in range(8):
        for function in least:
            start = time.process_time()
            function(0)
            least[function] = min(least[function], time.process_time() - start)
    hand, whole = (1e3 * seconds / number for seconds in least.values())
    print(f"by hand {hand:.3f} ms, fit {whole:.3f} ms, difference {whole - hand:.3f} ms")


if __name__ == "__main__":
    main()
