"""Milliseconds per frame of a task, and where they go; prints a table for docs/reference/tasks.md.

    python benchmarks/frame_times.py beads
    python benchmarks/frame_times.py voronoi spline --sizes 64 224

Each row is the fastest of several batches of frames, after some warm-up frames, and of several
passes over all rows, since few machines are idle all the time. "update", "render" and "copy" are
parts of the time of one process; with two processes each takes longer, but the frame is ready
sooner. Nothing else should run on the machine.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import fide_tasks

PARTS = ("update", "render", "copy")
BATCHES = 3
CANDIDATES = 4
SHORTEST = 0.3  # seconds that a batch takes at least


def configurations(name: str, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Options of each row of the table of a task."""
    if "spp" not in fide_tasks.options(name):
        yield from ({"size": size} for size in args.sizes)
        return
    for variant, size, spp in itertools.product(args.variants, args.sizes, args.spp):
        yield {"size": size, "spp": spp, "variant": variant}


def measure(name: str, options: dict[str, Any]) -> tuple[float, dict[str, float]]:
    """Seconds a frame, and the seconds of each part of it that the task tells."""
    task: Any = fide_tasks.make(name, **options)
    candidates = np.random.default_rng(0).random((CANDIDATES, task.dim))  # they differ in cost
    task.render(candidates)
    start = time.perf_counter()
    task.render(candidates)
    repeats = max(1, min(50, round(SHORTEST / (time.perf_counter() - start))))
    frames, best, parts = repeats * CANDIDATES, np.inf, dict[str, float]()
    for _ in range(BATCHES):
        before = dict(getattr(task, "times", {}))
        start = time.perf_counter()
        task.render(np.tile(candidates, (repeats, 1)))
        seconds = (time.perf_counter() - start) / frames
        if seconds < best:
            best = seconds
            parts = {p: (task.times[p] - before[p]) / frames for p in PARTS if p in before}
    return best, parts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names())
    add("--sizes", type=int, nargs="+", default=[112, 224], metavar="PX")
    add("--spp", type=int, nargs="+", default=[8, 16, 64], metavar="N")
    add("--variants", nargs="+", default=["llvm", "scalar"], metavar="NAME")
    add("--passes", type=int, default=2, metavar="N")
    args = parser.parse_args()
    rows = [(name, options) for name in args.tasks for options in configurations(name, args)]
    passes = [[measure(*row) for row in rows] for _ in range(args.passes)]
    columns = ["task", "variant", "size", "spp", "ms a frame", *PARTS]
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * 2 + "---:|" * (len(columns) - 2))
    for (name, options), measured in zip(rows, zip(*passes, strict=True), strict=True):
        seconds, parts = min(measured, key=lambda m: m[0])
        facts = [options.get(key, "") for key in ("variant", "size", "spp")]
        times = [seconds, *(parts.get(part, np.nan) for part in PARTS)]
        cells = ["" if np.isnan(t) else _milliseconds(t) for t in times]
        print("| " + " | ".join(map(str, [name, *facts, *cells])) + " |")


def _milliseconds(seconds: float) -> str:
    ms = 1e3 * seconds
    return f"{ms:.2f}" if ms < 1 else f"{ms:.1f}" if ms < 10 else f"{ms:.0f}"


if __name__ == "__main__":
    main()
