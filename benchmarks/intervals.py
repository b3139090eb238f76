"""Counts how often the truth lies in the 90 % interval that a solution states.

    python benchmarks/intervals.py                  # the runs that are missing
    python benchmarks/intervals.py waves disc       # the runs of these scenes that are missing
    python benchmarks/intervals.py --table
    python benchmarks/intervals.py --tuning         # other seeds, kept nowhere

Scenes: Voronoi with eight and with three cells, and Robot, 64 x 64.  The pictures of three cells
have a direction that nothing shows: their centers move away from their common corner.  The target
and every render have independent Gaussian noise of standard deviation 0.02 and are then clipped to
[0, 1].  The interval of a parameter is best.x +- 1.645 best.std, read after the last render.

The truth is the one of its equals that is nearest: cells may change places, and Robot's shoulder
reaches every pose twice (joints 1 and 3 by half a turn, joint 2 mirrored).

A run has *found* the truth if its best candidate without noise differs from the truth without noise
by less than the noise does (a mean square below 0.02^2).  An interval is local: of other basins it
knows nothing, so runs that found the truth are counted by themselves and with all others.

Clean renders, noisy target, as of a photograph (`clean_scenes`): waves, a picture linear in three
parameters, with the features `patch` and `dense`, and a soft disc by `fit`; each in color and in
gray, and after 200, 600 and 2,000 renders.

Each run is one line of benchmarks/results/intervals.jsonl.  A seed chooses the target, the
optimizer's random numbers and the noise.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import clean_scenes
import numpy as np
from clean_scenes import QUANTILE
from rows import Row, read, run_missing
from scipy.optimize import linear_sum_assignment

import fide_tasks
from fide_plugins import FIDE
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "intervals.jsonl"
SIZE, NOISE = 64, 0.02
REPORTING, TUNING = 100, 5000  # first seeds


class Scene(NamedTuple):
    """A task and how many runs of how many renders it gets."""

    task: str
    options: dict[str, int]
    renders: int
    runs: int
    tuning: int


SCENES = {
    "voronoi-8": Scene("voronoi", {"cells": 8}, 3000, 100, 16),
    "voronoi-3": Scene("voronoi", {"cells": 3}, 1500, 100, 16),
    "robot": Scene("robot", {}, 4000, 100, 12),
}


def cells(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs."""
    first = TUNING if arguments.tuning else REPORTING
    for name in arguments.scenes or [*SCENES, *clean_scenes.FEATURES]:
        scene = SCENES.get(name)
        if scene is None:
            seeds = range(first, first + (arguments.runs or clean_scenes.RUNS))
            yield from clean_scenes.cells(name, seeds)
            continue
        number = arguments.runs or (scene.tuning if arguments.tuning else scene.runs)
        for seed in range(first, first + number):
            yield {"scene": name, "seed": seed}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    names = ("scene", "seed", "colors", "features", "renders")
    return tuple(row.get(name) for name in names)


def run(cell: Row) -> Row:
    """One row."""
    if cell["scene"] not in SCENES:
        return clean_scenes.run(cell)
    scene, seed = SCENES[cell["scene"]], cell["seed"]
    task = fide_tasks.make(scene.task, SIZE, seed, **scene.options)
    truth, rng = task.x_star, np.random.default_rng((seed, 77))
    assert truth is not None

    def noisy(images: Float32) -> Float32:
        noise = rng.normal(0, NOISE, images.shape)
        return np.clip(images + noise, 0, 1).astype(np.float32)

    exact = task.render(truth[None])
    began = time.perf_counter()
    opt = FIDE(task.dim, noisy(exact)[0], seed=seed)
    while opt.evaluations < scene.renders:
        X = opt.ask()
        opt.tell(X, noisy(task.render(X)))
    seconds, best = time.perf_counter() - began, opt.best
    assert best is not None
    began = time.perf_counter()
    std = best.std
    reading = time.perf_counter() - began
    error = best.x - min(equals(task, truth, best.x), key=lambda x: float(np.abs(best.x - x).max()))
    missed = float(np.square(task.render(best.x[None]) - exact).mean())
    return {
        **cell,
        "found": missed < NOISE**2,
        "mse": missed,
        "loss": best.loss,
        "error": np.round(error, 6).tolist(),
        "std": None if std is None else np.round(std, 6).tolist(),
        "seconds": round(seconds, 2),
        "reading_ms": round(1000 * reading, 1),
    }


def equals(task: Any, truth: Float64, x: Float64) -> Iterator[Float64]:
    """Parameters (d,) of the truth's picture; of all orders of cells the one nearest to x (d,)."""
    if task.name == "voronoi":
        own, cells = x.reshape(task.cells, -1), truth.reshape(task.cells, -1)
        rows, order = linear_sum_assignment(np.abs(own[:, None] - cells).max(axis=2))
        yield cells[order[np.argsort(rows)]].ravel()
        return
    yield truth
    low, high = (np.array([getattr(p, end) for p in task.parameters]) for end in ("low", "high"))
    for one, three in itertools.product((-math.pi, math.pi), repeat=2):
        angles = low + truth * (high - low)
        angles[[0, 1, 2]] = angles[0] + one, -angles[1], angles[2] + three
        flipped = (angles - low) / (high - low)
        if ((flipped >= 0) & (flipped <= 1)).all():
            yield flipped


def table(rows: list[Row]) -> str:
    """Coverage of each scene, of runs that found the truth and of all of them."""
    columns = (
        "scene",
        "runs",
        "truth in the 90 % interval",
        "median std / abs(error)",
        "ms to read",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for name in SCENES:
        own = [row for row in rows if row["scene"] == name]
        found = [row for row in own if row["found"]]
        for label, some in ((f"{name}, found", found), (f"{name}, all", own)):
            known = [row for row in some if row["std"] is not None]
            if not known:
                continue
            error, std = (np.abs([row[what] for row in known]) for what in ("error", "std"))
            inside = error <= QUANTILE * std
            by_axis = inside.mean(axis=0)
            held = f"{inside.mean():.1%} ({by_axis.min():.0%} to {by_axis.max():.0%})"
            wide = float(np.median(std / np.maximum(error, 1e-9)))
            reading = np.median([row["reading_ms"] for row in known])
            runs = f"{len(known)} of {len(some)} known"
            lines.append(f"| {label} | {runs} | {held} | {wide:.1f} | {reading:.0f} |")
    return "\n".join(lines) + f"\n\n{clean_scenes.table(rows)}"


def main() -> None:
    """Do the runs that are missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=", ".join([*SCENES, *clean_scenes.FEATURES])
    )
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--runs", type=int, help="of each scene")
    arguments = parser.parse_args()
    if arguments.tuning:
        print(table([run(cell) for cell in cells(arguments)]))
        return
    if not arguments.table:
        run_missing(cells(arguments), run, RESULTS, key)
    print(table(read(RESULTS)))


if __name__ == "__main__":
    main()
