"""Samples per pixel at equal time: few, many, or as noise requires.

    python benchmarks/fidelity.py beads san_miguel --seeds 3
    python benchmarks/fidelity.py --table

FIDE (`balanced`, mean squared error) on the Mitsuba tasks, one thread.  Less than one sample per
pixel means one sample of 2 x 2 or 4 x 4 pixels: an image of half or a quarter of the side,
enlarged.  A run ends after a given CPU time, rendering and all else.  At each mark the task's
reference judges the best candidate so far (of those rendered with the largest number of samples so
far); this takes no time of the run.  A seed chooses the target, the optimizer's random numbers and
the noise.  Every run is a line of benchmarks/results/fidelity.jsonl, appended when it ends; a
second call does the missing runs.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Iterator
from fractions import Fraction
from math import isqrt
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins import FIDE, losses
from fide_plugins.experiments.run.pixel_samples import PixelSamples

RESULTS = Path(__file__).parent / "results" / "fidelity.jsonl"
CONFIGURATIONS = (
    "16",
    "4",
    "1",
    "as noise requires, 1 to 16",
    "as noise requires, 1/16 to 16",
)
MOST = 16
FINEST = 4  # of a side, that makes the smallest image
REST = 2**30  # begins the seeds of second renders


class Run:
    """One optimizer at work, until its time is over."""

    def __init__(self, cell: Row) -> None:
        self.cell = cell
        self.tasks = {
            by: fide_tasks.make(
                cell["task"], size=cell["size"] // by, seed=cell["seed"], threads=1, spp=MOST
            )
            for by in (1, 2, FINEST)
        }
        self.task = self.tasks[1]
        self.loss = losses.make("mse", self.task.target)
        self.optimizer = FIDE(self.task.dim, self.task.target, seed=cell["seed"], device="cpu")
        self.rule = rule(cell["configuration"])
        self.seconds, self.renders, self.samples = 0.0, 0, Fraction(0)
        self.level = Fraction(0)
        self.best = np.inf, np.full(self.task.dim, 0.5)
        self.marks: list[dict[str, Any]] = []

    def go(self) -> Row:
        for task in self.tasks.values():
            task.render(self.optimizer.x0[None], seed=[0])  # loads and compiles
        total = self.cell["seconds"]
        for mark in (total / 4, total / 2, total):
            while self.seconds < mark:
                before = time.process_time()
                self.generation()
                self.seconds += time.process_time() - before
            self.marks.append({
                "seconds": mark,
                "renders": self.renders,
                "samples": float(self.samples),
                "level": str(self.level),
                "judged": self.judged(self.best[1]),
            })  # fmt: skip
        return {**self.cell, "marks": self.marks}

    def number(self) -> Fraction:
        if self.rule is not None:
            return Fraction(self.rule.number, FINEST**2)
        return Fraction(self.cell["configuration"])

    def generation(self) -> None:
        X, level = self.optimizer.ask(), self.number()
        if level > self.level > 0:  # what was best is compared with the next at their level
            x = self.best[1]
            self.best = float(self.loss.compute(self.render(x[None], level))[0]), x
        self.level = level
        images = self.render(X, level)
        values = self.loss.compute(images)
        self.optimizer.tell(X, images, values)
        if self.rule is not None:
            again = None
            if self.rule.pair_due:
                again = float(self.loss.compute(self.render(X[:1], level))[0])
            self.rule.note(values, again)
        winner = int(np.argmin(values))
        if values[winner] < self.best[0]:
            self.best = float(values[winner]), X[winner]

    def render(self, X: Any, level: Fraction) -> Any:
        first = self.cell["seed"] * REST + self.renders
        self.renders, self.samples = self.renders + len(X), self.samples + level * len(X)
        by = isqrt(level.denominator)
        task = self.tasks[by]
        task.spp = level.numerator  # type: ignore[attr-defined]
        images = task.render(X, seed=[first + i for i in range(len(X))])
        return images.repeat(by, axis=1).repeat(by, axis=2)

    def judged(self, x: Any) -> float:
        return float(self.loss.compute(self.task.reference(x)[None])[0])


def rule(configuration: str) -> PixelSamples | None:
    """What chooses the samples, counted on 4 x 4 pixels."""
    if not configuration.startswith("as noise requires, "):
        return None
    least, most = configuration.removeprefix("as noise requires, ").split(" to ")
    return PixelSamples(int(Fraction(least) * FINEST**2), int(most) * FINEST**2)


def cells(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in range(arguments.seeds):
        for task in arguments.tasks:
            for configuration in arguments.configurations:
                yield {
                    "task": task,
                    "configuration": configuration,
                    "seed": seed,
                    "size": arguments.size,
                    "seconds": arguments.seconds,
                }


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return tuple(row[name] for name in ("task", "configuration", "seed", "size", "seconds"))


def table(rows: list[Row]) -> str:
    """Medians of the judged losses, in thousandths, and the range of the runs."""
    lines: list[str] = []
    for kind in dict.fromkeys((r["task"], r["size"], r["seconds"]) for r in rows):
        mine = [r for r in rows if (r["task"], r["size"], r["seconds"]) == kind]
        marks = [mark["seconds"] for mark in mine[0]["marks"]]
        titles = [*(f"{mark:g} s" for mark in marks), "renders", "samples", "at the end with"]
        lines += [f"| {kind[0]}, {kind[1]} px | runs | {' | '.join(titles)} |"]
        lines += ["|---" * (len(titles) + 2) + "|"]
        for configuration in (
            configuration
            for configuration in CONFIGURATIONS
            if any(r["configuration"] == configuration for r in mine)
        ):
            runs = [r["marks"] for r in mine if r["configuration"] == configuration]
            cells = [middle([run[i]["judged"] for run in runs]) for i in range(len(marks))]
            ends = [run[-1] for run in runs]
            cells += [
                f"{statistics.median(e[k] for e in ends):.0f}" for k in ("renders", "samples")
            ]
            cells += [", ".join(str(e["level"]) for e in ends)]
            lines.append(f"| {configuration} | {len(runs)} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def middle(values: list[float]) -> str:
    low, median, high = (1e3 * f(values) for f in (min, statistics.median, max))
    return f"{median:.3g} ({low:.3g} to {high:.3g})"


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="beads, san_miguel")
    parser.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        choices=CONFIGURATIONS,
        metavar="CONFIGURATION",
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU time of a run (60)")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    run_missing(cells(arguments), lambda cell: Run(cell).go(), arguments.out, key)


if __name__ == "__main__":
    main()
