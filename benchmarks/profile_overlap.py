"""Wall time relative to CMA-ES, with a renderer that takes 10 ms and does not use the CPU.

    python benchmarks/profile_overlap.py --renders 1000

The task is the same for all, Voronoi with 8 cells at 112 x 112.  Its frames are delayed, as if a
GPU or another program rendered them.  The network trains for 4 epochs, in the background and not.
Each optimizer runs alone: otherwise its training could continue during another one's turn.  Times
are measured from the end of one generation to the end of a later one, so that they contain as much
training as rendering.  CPU time counts all threads.  The table shows the median of the repeats.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import fide_tasks
from fide_lab import optimizers

GENERATION = 500  # renders, of the network; those of the others end in between
NETWORK = {"preset": "paper", "epochs": 4}
CONFIGURATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "CMA-ES": ("cma", {}),
    "FIDE fast": ("fide", {"preset": "fast"}),
    "FIDE balanced": ("fide", {}),
    "network, overlapped": ("fide", NETWORK),
    "network, one after the other": ("fide", {**NETWORK, "overlap": False}),
    "network of 8 tokens, overlapped": ("fide", {**NETWORK, "parameter_tokens": 8}),
}


class Late:
    """An optimizer at work on frames that come late."""

    def __init__(self, name: str, options: dict[str, Any], frame: float) -> None:
        self.task = fide_tasks.make("voronoi", size=112, seed=0)
        self.optimizer = optimizers.make(name, self.task.dim, self.task.target, seed=0, **options)
        self.ask = self.optimizer.ask_ready
        self.frame = frame

    def times(self, renders: int) -> tuple[float, float]:
        """Milliseconds of wall and CPU time a render, after the first 500."""
        self._go_on(GENERATION)
        before, wall, cpu = self.optimizer.evaluations, time.perf_counter(), time.process_time()
        self._go_on(GENERATION + renders)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        count = self.optimizer.evaluations - before
        self.optimizer.ask()  # waits for what still trains, which would disturb the next
        return 1e3 * wall / count, 1e3 * cpu / count

    def _go_on(self, until: int) -> None:
        while self.optimizer.evaluations < until:
            X = self.ask()
            end = time.perf_counter() + self.frame * len(X)
            images = self.task.render(X)
            time.sleep(max(0.0, end - time.perf_counter()))
            self.optimizer.tell(X, images)


def main() -> None:
    """Run all of them, and print their times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--renders", type=int, default=1000, help="a multiple of 500 (1000)")
    parser.add_argument("--frame", type=float, default=0.01, help="seconds (0.01)")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        choices=CONFIGURATIONS,
        metavar="CONFIGURATION",
    )
    arguments = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {
        configuration: [] for configuration in arguments.configurations
    }
    for _ in range(arguments.repeats):
        for configuration, times in found.items():
            times.append(
                Late(*CONFIGURATIONS[configuration], arguments.frame).times(arguments.renders)
            )
    print("| | ms a render | beside the first | ms of CPU time |\n|---|---|---|---|")
    medians = {configuration: np.median(times, axis=0) for configuration, times in found.items()}
    first, _ = medians[arguments.configurations[0]]
    for configuration, (wall, cpu) in medians.items():
        print(f"| {configuration} | {wall:.2f} | {wall / first:.3f} | {cpu:.2f} |")


if __name__ == "__main__":
    main()
