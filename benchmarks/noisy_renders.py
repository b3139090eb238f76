"""Compares presets, losses, steps and rivals where every render is noisy.

    python benchmarks/noisy_renders.py              # what is missing; can be stopped at any time
    python benchmarks/noisy_renders.py --table

The 80 problems of `image-fitting-v2` whose renders take milliseconds.  Each render has Gaussian
noise of its own, of standard deviation 0.05, and is then clipped to [0, 1]; the picture has none,
as if a path tracer had rendered it with many samples.  After 2,000 renders two answers are rendered
without noise: what the optimizer recommends, and the candidate whose noisy image had the lowest
loss.  The error of each is the mean squared error of its image, divided by the median one of 200
random candidates.  *Found*: the error of the recommended one is below 1 %.  Of the rivals only
`cma` minimizes the loss; `eki` and `dfols` fit features of the image.

Each run is one line of benchmarks/results/noisy_renders.jsonl.  The number of a target is the seed
of the optimizer; render i of a target number has the same noise in all runs, of any scene.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, by_key, command, finished_by_all
from suite import CHEAP, key

from fide_lab import run as harness
from fide_lab.report import statistics
from fide_lab.run.prepare import make_task
from fide_lab.suite import read as read_suite
from fide_lab.suite.page import sign_test
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "noisy_renders.jsonl"
SUITE, NOISE, RENDERS, FOUND = read_suite("image-fitting-v2"), 0.05, 2000, 0.01
OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "balanced": ("fide", {}),
    "accurate": ("fide", {"preset": "accurate"}),
    "no steps": ("fide", {"proposer": "linear"}),
    "popsize 20": ("fide", {"popsize": 20}),
    "cma": ("cma", {}),
    "eki": ("eki", {}),
    "dfols": ("dfols", {}),
}
CONFIGURATIONS = (
    *(f"{name}, mse" for name in OPTIONS),
    *(f"{name}, perceptual" for name in ("balanced", "accurate", "no steps", "popsize 20")),
)
_STREAM = 77  # of the noise; the optimizer draws from other ones


class Noisy:
    """A task whose renders are noisy; its picture is not."""

    def __init__(self, task: Any, number: int) -> None:
        self.dim, self.target, self.name = task.dim, task.target, task.name
        self._task, self._number = task, number

    def render(self, X: Float64, seed: Any = ()) -> Float32:
        """Images of candidates, (n, H, W, 3), each with the noise of its seed."""
        images: Float32 = self._task.render(X)
        for image, each in zip(images, seed, strict=True):
            rng = np.random.default_rng((_STREAM, self._number, each))
            image += NOISE * rng.standard_normal(image.shape, np.float32)
        return images.clip(0, 1)

    def reference(self, x: Float64) -> Float32:
        """The image of a point without noise, (H, W, 3)."""
        image: Float32 = self._task.render(x[None])[0]
        return image

    def error(self, x: Float64 | None) -> float:
        """Mean squared error of a point without noise."""
        assert x is not None
        return float(np.square(self.reference(x) - self.target).mean())


@cache
def usual_error(problem: str) -> float:
    """Median mean squared error of random candidates without noise."""
    task = task_of(problem)
    return float(
        np.median([task.error(x) for x in np.random.default_rng(0).random((200, task.dim))])
    )


def task_of(problem: str) -> Noisy:
    """The noisy task of a problem."""
    return Noisy(make_task(problem, 0, 0, {"suite": SUITE.name}), SUITE.parts(problem)[1])


def planned() -> Iterator[Row]:
    """All runs, targets outermost."""
    for number in range(len(SUITE.targets)):
        for scene in CHEAP:
            for name in CONFIGURATIONS:
                yield {"problem": SUITE.problem_of(scene, number), "optimizer": name}


def measure(run: Row) -> Row:
    """Errors of both answers."""
    problem, name = key(run)
    configuration, loss = name.split(", ")
    optimizer, options = OPTIONS[configuration]
    task, seed = task_of(problem), SUITE.parts(problem)[1]
    result = harness.run(task, optimizer, loss, RENDERS, seed, options=options)
    return {
        **run,
        "error": task.error(result.x_recommended) / usual_error(problem),
        "error_of_best": task.error(result.x_best) / usual_error(problem),
        "seconds": round(result.wall_s, 1),
    }


def table(rows: list[Row]) -> str:
    """Found problems and median errors; then the pairs."""
    found = by_key(rows, key)
    whole = finished_by_all(found, CONFIGURATIONS)
    if not whole:
        sys.exit("no problem is finished by all configurations")
    head = [f"found of {len(whole)}", *CHEAP, "median error", "of the lowest loss"]
    lines = [["", *head], ["---"] * (1 + len(head))]
    for name in CONFIGURATIONS:
        error, best = (_column(found, whole, name, v) for v in ("error", "error_of_best"))
        scene = np.array([SUITE.parts(p)[0] for p in whole])
        counts = [str((error[scene == each] < FOUND).sum()) for each in CHEAP]
        medians = [f"{np.median(errors):.2g}" for errors in (error, best)]
        lines.append([name, str((error < FOUND).sum()), *counts, *medians])
    text = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([*text, *_pairs(found, whole), *_answers(found, whole)])


def _column(
    found: dict[tuple[str, str], Row], problems: list[str], name: str, value: str
) -> Float64:
    return np.array([found[problem, name][value] for problem in problems])


def _pairs(found: dict[tuple[str, str], Row], problems: list[str]) -> Iterator[str]:
    """The default against all others with its loss, and with each loss; p adjusted for all."""
    errors = {name: _column(found, problems, name, "error") for name in CONFIGURATIONS}
    others = [n for n in CONFIGURATIONS if not n.startswith("balanced")]
    pairs = [(f"balanced, {n.split(', ')[1]}", n) for n in others]
    pairs.append(("balanced, mse", "balanced, perceptual"))
    # The sign test of zeros and ones is the exact McNemar test.
    missed = {name: (values >= FOUND).astype(float) for name, values in errors.items()}
    for what, values in (("found by only", missed), ("lower error of", errors)):
        p = statistics.adjusted([sign_test(values[a], values[b]) for a, b in pairs])
        for (a, b), each in zip(pairs, p, strict=True):
            yield f"- {a} and {b}: {what} {_ahead(values[a], values[b])}, p = {each:.2g}"


def _answers(found: dict[tuple[str, str], Row], problems: list[str]) -> Iterator[str]:
    """The recommended point against the one of the lowest loss; p not adjusted."""
    for name in CONFIGURATIONS:
        a, b = (_column(found, problems, name, v) for v in ("error", "error_of_best"))
        ahead, p = _ahead(a, b), sign_test(a, b)
        yield f"- {name}, recommended and lowest: lower error of {ahead}, p = {p:.2g}"


def _ahead(a: Float64, b: Float64) -> str:
    return f"the first {(a < b).sum()}, the second {(a > b).sum()}"


if __name__ == "__main__":
    command(__doc__ or "", planned(), measure, RESULTS, key, table)
