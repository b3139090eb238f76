"""Where the time of a generation goes.

    python benchmarks/profile_generation.py parts voronoi spline --presets balanced fast paper
    python benchmarks/profile_generation.py table       # of the recorded measurements

Times are CPU times, one thread, so that other programs affect them little.  The time of each part
excludes the parts that it calls.  Every measurement is a line of the file `--out`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from rows import Row, append, read

import fide_tasks
from fide_plugins import FIDE
from fide_plugins.search.cma_es import CMAES

RESULTS = Path(__file__).parent / "results" / "profile.jsonl"
PARTS = ("render", "loss", "encode", "train", "sample", "search", "copy", "rest")


class Stopwatch:
    """CPU time by part; a part that calls another stands still meanwhile."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._note()
        self._running.append(name)
        try:
            yield
        finally:
            self._note()
            self._running.pop()

    def _note(self) -> None:
        now = time.process_time()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def wrap(self, owner: Any, method: str, name: str) -> Callable[[], None]:
        """Count `owner.method` as that part; returns what undoes it."""
        original = getattr(owner, method)

        def timed(*arguments: Any, **options: Any) -> Any:
            with self.part(name):
                return original(*arguments, **options)

        setattr(owner, method, timed)
        return lambda: setattr(owner, method, original)


def watched(optimizer: FIDE, watch: Stopwatch) -> list[Callable[[], None]]:
    """Have the parts of an optimizer timed; returns what ends that."""
    undo = [
        watch.wrap(CMAES, "sample", "search"),
        watch.wrap(CMAES, "tell", "search"),
        watch.wrap(optimizer.evaluator, "as_batch", "copy"),
        watch.wrap(optimizer.state, "record", "copy"),
        watch.wrap(optimizer.encoder, "compute", "encode"),
        watch.wrap(optimizer.evaluator.loss, "compute", "loss"),
    ]
    if optimizer.state.proposer is not None:
        undo += [
            watch.wrap(optimizer.state.proposer, "update", "train"),
            watch.wrap(optimizer.state.proposer, "propose", "sample"),
        ]
    return undo


def parts(task_name: str, preset: str, size: int, renders: int, options: dict[str, Any]) -> Any:
    """Milliseconds an evaluation, by part, of a run by hand."""
    task = fide_tasks.make(task_name, size=size, seed=0)
    optimizer = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu", **options)
    watch = Stopwatch()
    undo = watched(optimizer, watch)
    try:
        while optimizer.evaluations < renders:
            with watch.part("rest"):
                X = optimizer.ask()
            with watch.part("render"):
                images = task.render(X)
            with watch.part("rest"):
                optimizer.tell(X, images)
    finally:
        for step in undo:
            step()
    return {part: 1e3 * s / optimizer.evaluations for part, s in watch.seconds.items()}


def table(rows: Sequence[Row]) -> str:
    """Milliseconds by part, in Markdown; of the same cell the last."""
    last = {row["cell"]: row["ms"] for row in rows}
    lines = [f"| | {' | '.join(PARTS)} | all but rendering |", "|---" * (len(PARTS) + 2) + "|"]
    for cell, ms in last.items():
        values = [*(ms[part] for part in PARTS), overhead(ms)]
        lines.append(f"| {cell} | {' | '.join(f'{value:.3f}' for value in values)} |")
    return "\n".join(lines)


def overhead(ms: dict[str, float]) -> float:
    return sum(ms.values()) - ms["render"]


def run_parts(arguments: argparse.Namespace) -> None:
    for task in arguments.tasks:
        for preset in arguments.presets:
            for size in arguments.sizes:
                options = (
                    {"epochs": arguments.epochs, "overlap": False} if preset == "paper" else {}
                )
                renders = arguments.renders * (2 if preset == "paper" else 1)
                ms = parts(task, preset, size, renders, options)
                said = f", {arguments.epochs} epochs" if preset == "paper" else ""
                cell = f"{task}, {preset}{said}, {size} px"
                print(f"{cell:42} {overhead(ms):.3f} ms", flush=True)
                append(arguments.out, {"cell": cell, "ms": ms})


def main() -> None:
    """Measure, or print the table."""
    arguments = parse_arguments()
    torch.set_num_threads(1)
    if arguments.what == "table":
        print(table(read(arguments.out)))
    else:
        run_parts(arguments)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("parts", "table"))
    parser.add_argument("tasks", nargs="*", default=["voronoi"])
    parser.add_argument("--presets", nargs="+", default=["fast", "balanced", "accurate", "paper"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[112, 224])
    parser.add_argument("--epochs", type=int, default=4, help="epochs of the preset paper (4)")
    parser.add_argument("--renders", type=int, default=1000, help="renders; paper: twice as many")
    parser.add_argument("--out", type=Path, default=RESULTS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
