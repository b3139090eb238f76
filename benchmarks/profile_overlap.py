"""Wall time beside CMA-ES's, with a renderer that takes 10 ms and leaves the processor alone.

    python benchmarks/profile_overlap.py --renders 1000

The same task for all, Voronoi with 8 cells at 112 x 112, whose frames come late, as from a GPU or
another program.  The network is trained for 4 epochs, in the background and not.  Optimizers take
turns, a part of the renders each, so that other programs disturb all of them alike.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import fide_tasks
from fide_plugins import optimizers

NETWORK = {"preset": "paper", "epochs": 4}
ARMS: dict[str, tuple[str, dict[str, Any]]] = {
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
        self.ask = getattr(self.optimizer, "ask_ready", self.optimizer.ask)
        self.frame, self.wall, self.cpu = frame, 0.0, 0.0

    def go_on(self, until: int) -> None:
        """To the end of the generation in which so many renders are reached."""
        wall, cpu = time.perf_counter(), time.process_time()
        while self.optimizer.evaluations < until:
            X = self.ask()
            end = time.perf_counter() + self.frame * len(X)
            images = self.task.render(X)
            time.sleep(max(0.0, end - time.perf_counter()))
            self.optimizer.tell(X, images)
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


def main() -> None:
    """Run all of them, and print their times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--renders", type=int, default=1000)
    parser.add_argument("--frame", type=float, default=0.01, help="seconds (0.01)")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS, metavar="ARM")
    arguments = parser.parse_args()
    runs = {arm: Late(*ARMS[arm], arguments.frame) for arm in arguments.arms}
    for until in np.linspace(0, arguments.renders, 6)[1:].astype(int):
        for run in runs.values():
            run.go_on(int(until))
    print("| | ms a render | beside the first | of them processor |\n|---|---|---|---|")
    first = next(iter(runs.values()))
    for arm, run in runs.items():
        wall, cpu = (1e3 * s / run.optimizer.evaluations for s in (run.wall, run.cpu))
        beside = wall * first.optimizer.evaluations / (1e3 * first.wall)
        print(f"| {arm} | {wall:.2f} | {beside:.3f} | {cpu:.2f} |", flush=True)


if __name__ == "__main__":
    main()
