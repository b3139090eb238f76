"""What the run loop itself costs: CPU time of an evaluation of CMA-ES, with and without it.

    python benchmarks/harness_overhead.py

The same optimizer, task, loss and seed run in a loop by hand, and in the run loop with everything
that `fide compare` records.  Rendering takes almost no time, so the loop remains.  The two take
turns, and the table shows the minimum CPU time of each, which other programs affect least.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from fide_lab import optimizers, run as harness
from fide_plugins import losses
from fide_plugins.validation.images import as_batch


class Tint:
    """The cheapest task there is: a plain color; 40 parameters, as Voronoi with 8 cells."""

    name, dim, seed = "tint", 40, 0

    def __init__(self, size: int) -> None:
        self.target = np.full((size, size, 3), 0.25, np.float32)

    def render(self, X: NDArray[np.float64], seed: Any = None) -> NDArray[np.float32]:
        images = np.empty((len(X), *self.target.shape), np.float32)
        images[:] = X[:, :39].reshape(len(X), 13, 3).mean(axis=1)[:, None, None, :]
        return images


def main() -> None:
    arguments = parse_arguments()
    ways = {
        "by hand": by_hand,
        "harness, nothing written": in_memory,
        "harness, as fide compare": as_compared,
    }
    fastest = dict.fromkeys(ways, np.inf)
    for _ in range(arguments.repeats):
        for name, way in ways.items():
            fastest[name] = min(fastest[name], way(arguments.size, arguments.budget))
    base = fastest["by hand"]
    for name, seconds in fastest.items():
        each, more = (1e3 * s / arguments.budget for s in (seconds, seconds - base))
        print(f"{name:26} {each:.3f} ms an evaluation, {more:+.3f}")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--budget", type=int, default=4000)
    parser.add_argument("--repeats", type=int, default=3)
    return parser.parse_args()


def by_hand(size: int, budget: int) -> float:
    """CPU seconds of ask, render, loss, tell, and nothing else."""
    task = Tint(size)
    loss = losses.resolve("mse", task.target)
    optimizer = optimizers.make("cma", task.dim, task.target, seed=0)
    start = time.process_time()
    while optimizer.evaluations < budget:
        X = optimizer.ask()[: budget - optimizer.evaluations]
        images = as_batch(task.render(X), task.target.shape, n=len(X))
        optimizer.tell(X, images, loss.compute(images))
    return time.process_time() - start


def in_memory(size: int, budget: int) -> float:
    """CPU seconds of a run without a directory."""
    run = harness.prepare(Tint(size), "cma", "mse", budget, 0)
    start = time.process_time()
    run.execute()
    return time.process_time() - start


def as_compared(size: int, budget: int) -> float:
    """CPU seconds of a run with its directory, the metrics and the film of a comparison."""
    keep = harness.Keep(("mse", "perceptual"), film=True, summary=False, checkpoint=False)
    with tempfile.TemporaryDirectory() as folder:
        run = harness.prepare(
            Tint(size), "cma", "mse", budget, 0, out=Path(folder, "run"), keep=keep
        )
        start = time.process_time()
        run.execute()
        return time.process_time() - start


if __name__ == "__main__":
    main()
