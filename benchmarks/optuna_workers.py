"""How many trials several workers need for the result of one worker.

    python benchmarks/optuna_workers.py --out benchmarks/results/optuna_workers.jsonl
    python benchmarks/optuna_workers.py --table benchmarks/results/optuna_workers.jsonl

Eight Voronoi cells, 40 parameters.  Each worker has its own sampler; all share one study in memory.
They take turns by a simulated clock: the time of a trial is drawn from a log-normal distribution
(standard deviation 0.3 of the logarithm), and asking and telling take no time.  So the results do
not depend on the number of cores.  The same targets and seeds for all.

With ``--direct`` one replica of the optimizer replaces the samplers.  It gets what they would read
from the storage: the same losses to the last digit, in a quarter of the time.
"""

from __future__ import annotations

import argparse
import heapq
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from rows import Row, read, run_missing
from torch import Tensor

import fide_tasks
from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.features import ImageEvaluator
from fide_plugins import FIDE
from fide_plugins.distributed.replica import Replica
from fide_plugins.recording.record import best_so_far

TRIALS = 1000
EVERY = 25
SIZE = 64
SPREAD = 0.3
LEVELS = (200, 400, 600)  # trials of one worker

Runs: TypeAlias = dict[int, list[Any]]
"""Curves of several runs, by target."""


def cells(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in range(arguments.seeds):
        for target in range(arguments.targets):
            for workers in arguments.workers:
                yield {"workers": workers, "target": target, "seed": seed}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["workers"], row["target"], row["seed"]


def run(workers: int, target: int, seed: int) -> Row:
    """Best loss after every 25 completed trials, and what the trials counted as."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    task = fide_tasks.make("voronoi", size=SIZE, seed=target)
    storage = optuna.storages.InMemoryStorage()
    optuna.create_study(study_name="workers", storage=storage)
    samplers = [FIDESampler(task.target, seed=seed) for _ in range(workers)]
    studies = [
        optuna.load_study(study_name="workers", storage=storage, sampler=sampler)
        for sampler in samplers
    ]
    clock = np.random.default_rng([seed, workers])
    busy: list[tuple[float, int, optuna.Trial]] = []
    losses: list[float] = []

    def begin(worker: int, now: float) -> None:
        trial = studies[worker].ask()
        for i in range(task.dim):
            trial.suggest_float(f"x{i}", 0, 1)
        heapq.heappush(busy, (now + clock.lognormal(0.0, SPREAD), worker, trial))

    for worker in range(workers):
        begin(worker, 0.0)
    while len(losses) < TRIALS:
        now, worker, trial = heapq.heappop(busy)
        x = np.array([[trial.params[f"x{i}"] for i in range(task.dim)]])
        loss = samplers[worker].tell_image(trial, task.render(x)[0])
        studies[worker].tell(trial, loss)
        losses.append(loss)
        begin(worker, now)
    curve = best_so_far(losses)[EVERY - 1 :: EVERY]
    return {"curve": curve.tolist(), "counts": samplers[0].counts(studies[0])}


def run_direct(workers: int, target: int, seed: int) -> Row:
    """As `run`, by what every sampler does with what it reads."""
    task = fide_tasks.make("voronoi", size=SIZE, seed=target)
    replica = Replica(FIDE(task.dim, task.target, seed=seed))
    evaluator = ImageEvaluator(lambda: replica.optimizer.evaluator)
    clock = np.random.default_rng([seed, workers])
    busy: list[tuple[float, int]] = []
    asked: list[tuple[int, int, bool, Any]] = []  # generation, slot, proposed, x; by number
    done: dict[int, tuple[float, Any]] = {}
    losses: list[float] = []
    first = told = 0
    counts: Counter[str] = Counter()

    def begin(now: float) -> None:
        slot = len(asked) - first
        candidate = replica.newest(slot, len(asked) - told)
        heapq.heappush(busy, (now + clock.lognormal(0.0, SPREAD), len(asked)))
        asked.append((replica.generation, slot, candidate.proposed, candidate.x.copy()))

    for _ in range(workers):
        begin(0.0)
    while len(losses) < TRIALS:
        now, number = heapq.heappop(busy)
        image = evaluator.read(task.render(asked[number][3][None])[0])
        tokens: Tensor | None = evaluator.tokens(image)
        if tokens is not None and workers > 1:  # who is alone learns from features as they are
            tokens = evaluator.codec.unpack(evaluator.codec.pack(tokens))
        done[number] = evaluator.loss(image), tokens
        losses.append(done[number][0])
        while told in done:
            generation, slot, proposed, x = asked[told]
            now_at = replica.generation
            loss, learned = done.pop(told)
            role = replica.tell(
                x, loss, learned, generation=generation, slot=slot, proposed=proposed
            )
            counts[role.value] += 1
            told += 1
            first = told if replica.generation != now_at else first
        begin(now)
    curve = best_so_far(losses)[EVERY - 1 :: EVERY]
    return {"curve": curve.tolist(), "counts": {**counts, "image": counts.total()}}


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("runs/optuna_workers.jsonl"))
    parser.add_argument("--table", type=Path)
    parser.add_argument("--direct", action="store_true")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(
        cells(arguments),
        lambda cell: {**cell, **(run_direct if arguments.direct else run)(**cell)},
        arguments.out,
        key,
    )


def table(rows: list[Row]) -> str:
    """Trials to the loss that one worker has after n trials, over those of one worker.

    That loss is the median of one worker's runs for the same target.  Geometric means over runs and
    targets (a run that is not there at its end counts with its length), with 95 % intervals from
    drawing the seeds of both again.
    """
    runs: dict[int, Runs] = {}
    for row in rows:
        by_target = runs.setdefault(row["workers"], {})
        by_target.setdefault(row["target"], []).append(np.array(row["curve"]))
    head = " | ".join(f"to the loss of {n} trials alone" for n in LEVELS)
    lines = [f"| workers | runs | {head} | late |", "|---|---|" + "---|" * (len(LEVELS) + 1)]
    for workers in sorted(set(runs) - {1}):
        texts = [interval(runs[workers], runs[1], n) for n in LEVELS]
        counts = [row["counts"] for row in rows if row["workers"] == workers]
        late = np.mean([c.get("late", 0) / sum_of(c) for c in counts])
        lines.append(f"| {workers} | {len(counts)} | {' | '.join(texts)} | {late:.0%} |")
    return "\n".join(lines)


def interval(runs: Runs, alone: Runs, n: int) -> str:
    """Ratio at the level of n trials alone, and its interval."""
    rng = np.random.default_rng(0)
    again = [ratio(drawn(runs, rng), drawn(alone, rng), n) for _ in range(2000)]
    low, high = np.percentile(again, [2.5, 97.5])
    return f"{ratio(runs, alone, n):.2f} ({low:.2f} to {high:.2f})"


def drawn(runs: Runs, rng: np.random.Generator) -> Runs:
    """As many runs of each target, drawn with replacement."""
    return {
        target: [curves[i] for i in rng.integers(len(curves), size=len(curves))]
        for target, curves in runs.items()
    }


def ratio(runs: Runs, alone: Runs, n: int) -> float:
    """Geometric mean over targets of trials to the level, of runs and of those alone."""
    logs = []
    for target, curves in runs.items():
        level = float(np.median([curve[n // EVERY - 1] for curve in alone[target]]))
        both = ([trials_to(c, level) for c in several] for several in (curves, alone[target]))
        several, one = (np.mean(np.log(trials)) for trials in both)
        logs.append(several - one)
    return float(np.exp(np.mean(logs)))


def sum_of(counts: dict[str, int]) -> int:
    """Trials that were told."""
    return sum(counts.get(role, 0) for role in ("member", "altered", "late", "injected"))


def trials_to(curve: Any, level: float) -> float:
    """Trials after which a falling curve is at the level, or its length."""
    there = np.flatnonzero(curve <= level)
    return float(EVERY * (there[0] + 1 if len(there) else len(curve)))


if __name__ == "__main__":
    main()
