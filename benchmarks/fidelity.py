"""Renders as coarse as the step needs, against full ones: the courtyard's camera in the same time.

    python benchmarks/fidelity.py --targets 0-9 --seconds 120   # what is missing
    python benchmarks/fidelity.py --table

San Miguel of `image-fitting-v1` at 112 x 112 pixels, loss `perceptual`, in one process and one
thread.  *full*: 4 samples a pixel always.  *fidelity*: `Fidelity(size=(28, 112), samples=(1, 4))`.
The clock of a run is its CPU time, so other programs do not count; loading and compiling are before
it, judging is after it: by the task's reference, which has little noise.  The number of a target is
the seed.  Each run is one line of benchmarks/results/fidelity.jsonl.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from moves import span
from rows import Row, read, run_missing

import fide_tasks
from fide_lab.suite import read as read_suite
from fide_plugins import Fidelity, fit, losses
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "fidelity.jsonl"
SUITE = read_suite("image-fitting-v1")
SCENE, SIZE, SAMPLES, LOSS = "san_miguel", 112, 4, "perceptual"
SOLVED = SUITE.scenes[SCENE].solved
SHARES = (0.25, 0.5, 1.0)  # of the time, at which the best candidate is judged
WAYS = {
    "full": Fidelity(size=None, samples=(SAMPLES, SAMPLES)),
    "fidelity": Fidelity(size=(28, SIZE), samples=(1, SAMPLES)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", type=span, default=range(10), metavar="A-B")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    planned = (
        {"target": number, "way": way, "seconds": arguments.seconds}
        for number in arguments.targets
        for way in WAYS
    )
    run_missing(planned, one_run, arguments.out, lambda row: (row["target"], row["way"]))


def one_run(run: Row) -> Row:
    """The judged loss of the best candidate after each share of the time."""
    number, seconds = run["target"], run["seconds"]
    seed = SUITE.targets[number]
    tasks = {
        side: fide_tasks.make(SCENE, side, seed=seed, spp=SAMPLES, threads=1) for side in (28, 56)
    }
    whole = tasks[SIZE] = fide_tasks.make(SCENE, SIZE, seed=seed, spp=SAMPLES, threads=1)

    def render(x: Float64, *, size: tuple[int, int], samples: int, seed: int) -> Float32:
        task: Any = tasks[size[0]]
        task.spp = samples
        image: Float32 = task.render(x[None], seed=[seed])[0]
        return image

    for side in tasks:
        render(np.full(whole.dim, 0.5), size=(side, side), samples=1, seed=0)  # loads, compiles
    marks: list[Float64 | None] = [None] * len(SHARES)

    def watch(event: Any) -> None:
        for i, share in enumerate(SHARES[:-1]):
            if marks[i] is None and event.seconds >= share * seconds:
                marks[i] = event.optimizer.best.x.copy()

    clock, time.perf_counter = time.perf_counter, time.process_time
    try:
        result = fit(
            render, whole.target, whole.dim, budget=None, time=seconds, loss=LOSS, seed=number,
            workers=0, fidelity=WAYS[run["way"]], until="budget", callbacks=watch, device="cpu",
        )  # fmt: skip
    finally:
        time.perf_counter = clock
    assert result.best is not None
    marks[-1] = result.best.x
    judge = losses.make(LOSS, whole.target)
    judged = [float(judge.compute(whole.reference(x)[None])[0]) for x in marks if x is not None]
    return {
        **run,
        "renders": result.evaluations,
        "cost": round(result.cost, 1),
        "judged": [round(loss, 5) for loss in judged],
    }


def table(rows: list[Row]) -> str:
    """Medians of the judged losses, how many are solved, and renders, of each way."""
    text = ["| | targets | loss at a quarter, half, the end | solved | renders | cost |"]
    text.append("|---|---:|---|---|---:|---:|")
    for way in WAYS:
        some = [row for row in rows if row["way"] == way]
        judged = np.array([row["judged"] for row in some])
        middle = ", ".join(f"{one:.3g}" for one in np.median(judged, axis=0))
        solved = ", ".join(str(one) for one in (judged <= SOLVED).sum(axis=0))
        renders, cost = (np.median([row[key] for row in some]) for key in ("renders", "cost"))
        text.append(f"| {way} | {len(some)} | {middle} | {solved} | {renders:,.0f} | {cost:,.0f} |")
    return "\n".join(text)


if __name__ == "__main__":
    main()
