"""Samples per pixel at equal time: few, many, or as noise requires.

    python benchmarks/pixel_samples.py                # what is missing; can be stopped at any time
    python benchmarks/pixel_samples.py --table

FIDE's default with `perceptual` on San Miguel and Beads, the ten targets of `image-fitting-v1`, 112
pixels, one thread.  A run ends after 60 seconds of CPU time, rendering and all else.  At each mark
the task's reference, an image with little noise that the search has not seen, judges the best
candidate so far; this takes no time of the run.  *1 to 16* begins with one sample and takes more
as noise requires, as `fide run --spp 16 --least-spp 1` does.

Each run is one line of benchmarks/results/pixel_samples.jsonl.  The number of a target is the seed
of the optimizer, and of the noise.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, by_key, command, finished_by_all

import fide_tasks
from fide_lab.run.pixel_samples import PixelSamples
from fide_lab.suite import read as read_suite
from fide_lab.suite.page import sign_test
from fide_plugins import FIDE, losses
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "pixel_samples.jsonl"
SUITE = read_suite("image-fitting-v1")
SCENES, SIZE, LOSS = ("beads", "san_miguel"), 112, "perceptual"
MOST, RULE = 16, "1 to 16"
CONFIGURATIONS = ("16", "4", "1", RULE)
MARKS = (15, 30, 60)  # seconds of CPU time
SEEDS = 2**20  # of renders of one target, more than there are in a run


class Run:
    """One search, until its time is over."""

    def __init__(self, problem: str, configuration: str) -> None:
        name, self.number = SUITE.parts(problem)
        self.task: Any = fide_tasks.make(
            name, SIZE, seed=SUITE.problem(problem)[1], spp=MOST, threads=1
        )
        self.loss = losses.make(LOSS, self.task.target)
        self.optimizer = FIDE(self.task.dim, self.task.target, seed=self.number, device="cpu")
        least, most = (1, MOST) if configuration == RULE else (int(configuration),) * 2
        self.rule = PixelSamples(least, most)
        self.samples = self.renders = 0
        self.best_samples, self.best = self.rule.number, (np.inf, np.full(self.task.dim, 0.5))

    def marks(self) -> Iterator[Row]:
        """What is found after each mark."""
        self.task.render(self.optimizer.x0[None], seed=[0])  # loads and compiles
        seconds = 0.0
        for mark in MARKS:
            while seconds < mark:
                before = time.process_time()
                self.step()
                seconds += time.process_time() - before
            yield {
                "seconds": mark,
                "renders": self.renders,
                "samples": self.samples,
                "number": self.rule.number,
                "judged": self.judged(),
            }

    def step(self) -> None:
        """Render and tell what the optimizer asks for: a generation, or a step between two."""
        X = self.optimizer.ask_ready()
        if self.rule.number > self.best_samples:  # losses with fewer samples do not compare
            x = self.best[1]
            self.best_samples, self.best = self.rule.number, (self.value(x), x)
        images = self.render(X)
        values = self.loss.compute(images)
        self.optimizer.tell(X, images, values)
        self.rule.note(values, self.value(X[0]) if self.rule.pair_due else None)
        winner = int(np.argmin(values))
        if values[winner] < self.best[0]:
            self.best = float(values[winner]), X[winner]

    def render(self, X: Float64) -> Float32:
        """Noisy images of candidates (n, dim), each with noise of its own."""
        self.task.spp = self.rule.number
        first = self.number * SEEDS + self.renders
        self.renders += len(X)
        self.samples += self.rule.number * len(X)
        images: Float32 = self.task.render(X, seed=[first + i for i in range(len(X))])
        return images

    def value(self, x: Float64) -> float:
        """Loss of another render of a candidate (dim,)."""
        return float(self.loss.compute(self.render(x[None]))[0])

    def judged(self) -> float:
        """Loss of the best candidate, by the task's reference."""
        self.task.spp = MOST
        return float(self.loss.compute(self.task.reference(self.best[1])[None])[0])


def key(row: Row) -> tuple[str, str]:
    """What makes a run."""
    return row["problem"], row["configuration"]


def planned() -> Iterator[Row]:
    """All runs, targets outermost."""
    for number in range(len(SUITE.targets)):
        for scene in SCENES:
            for configuration in CONFIGURATIONS:
                problem = SUITE.problem_of(scene, number)
                yield {"problem": problem, "configuration": configuration}


def measure(run: Row) -> Row:
    """What one run has found at the marks."""
    return {**run, "marks": list(Run(*key(run)).marks())}


def table(rows: list[Row]) -> str:
    """Medians and ranges of the judged losses, what is solved; sign tests against 16 samples."""
    found = by_key(rows, key)
    whole = finished_by_all(found, CONFIGURATIONS)
    if not whole:
        sys.exit("no problem is finished with all numbers of samples")
    text = []
    for scene in SCENES:
        some = [problem for problem in whole if SUITE.parts(problem)[0] == scene]
        titles = [f"{scene}, {len(some)} targets", *(f"{mark} s" for mark in MARKS)]
        titles += [f"below 16 by {mark} s, p" for mark in MARKS]
        titles += ["solved", "renders", "ends with"]
        text += [_line(titles), _line(["---"] * len(titles))]
        marks = {c: [found[problem, c]["marks"] for problem in some] for c in CONFIGURATIONS}
        for configuration, runs in marks.items():
            usual = marks[CONFIGURATIONS[0]]
            text.append(_line([configuration, *_cells(runs, usual, SUITE.scenes[scene].solved)]))
        text.append("")
    return "\n".join(text)


def _cells(runs: list[list[Row]], usual: list[list[Row]], solved: float) -> list[str]:
    """Of one number of samples and the usual one: marks of the runs, target by target."""
    judged, others = ([_judged(which, i) for i in range(len(MARKS))] for which in (runs, usual))
    ends = Counter(run[-1]["number"] for run in runs)
    return [
        *map(_range, judged),
        *map(_compared, judged, others),
        ", ".join(str((losses <= solved).sum()) for losses in judged),
        f"{statistics.median(run[-1]['renders'] for run in runs):,.0f}",
        ", ".join(f"{n} in {times}" for n, times in sorted(ends.items())),
    ]


def _judged(runs: list[list[Row]], mark: int) -> Float64:
    return np.array([run[mark]["judged"] for run in runs])


def _range(values: Float64) -> str:
    return f"{np.median(values):.3g} ({values.min():.3g} to {values.max():.3g})"


def _compared(values: Float64, usual: Float64) -> str:
    below = int(np.sum(values < usual))
    return "" if np.array_equal(values, usual) else f"{below}, {sign_test(values, usual):.2g}"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    command(__doc__ or "", planned(), measure, RESULTS, key, table)
