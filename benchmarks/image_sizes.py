"""Compares sides of the images that are rendered.

    python benchmarks/image_sizes.py                # what is missing; can be stopped at any time
    python benchmarks/image_sizes.py --table

The 80 problems of `image-fitting-v2` whose renders take milliseconds, with images of a quarter,
half and all of the side that the suite gives the scene (64 or 112 pixels).  Of each run of 2,000
renders the best parameters are rendered with the whole side.  *Solved*: the loss of this image is
at most what the suite asks for.

Each run is one line of benchmarks/results/image_sizes.jsonl.  The number of a target is the seed of
the optimizer, FIDE's default.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, by_key, command, finished_by_all
from suite import CHEAP

from fide_lab import run as harness
from fide_lab.run.prepare import make_task
from fide_lab.suite import read as read_suite
from fide_lab.suite.page import sign_test
from fide_plugins import losses
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results" / "image_sizes.jsonl"
SUITE, RENDERS = read_suite("image-fitting-v2"), 2000
PARTS = (4, 2, 1)  # of the side


def key(row: Row) -> tuple[str, int]:
    """What makes a run."""
    return row["problem"], row["part"]


def planned() -> Iterator[Row]:
    """All runs, targets outermost."""
    for number in range(len(SUITE.targets)):
        for name in CHEAP:
            for part in PARTS:
                yield {"problem": SUITE.problem_of(name, number), "part": part}


def measure(run: Row) -> Row:
    """Loss of the best parameters, rendered with the whole side."""
    problem, part = key(run)
    scene, target_seed = SUITE.problem(problem)
    small, whole = (
        make_task(str(scene.task), side, target_seed, scene.options)
        for side in (scene.size // part, scene.size)
    )
    result = harness.run(small, "fide", scene.loss, RENDERS, seed=SUITE.parts(problem)[1])
    assert result.x_best is not None
    image = whole.render(result.x_best[None])
    return {
        **run,
        "loss": float(losses.make(scene.loss, whole.target)(image)[0]),
        "loss_of_run": float(np.nanmin(result.losses)),
        "seconds": round(result.wall_s, 1),
    }


def table(rows: list[Row]) -> str:
    """Solved problems and mean seconds by part of the side; p of the pairs with the whole side."""
    found = by_key(rows, key)
    whole = finished_by_all(found, PARTS)
    if not whole:
        sys.exit("no problem is finished with all sides")
    lines = [["scene", *(f"1/{part}" for part in PARTS)], ["---"] * (1 + len(PARTS))]
    for scene in (*CHEAP, "all"):
        some = [p for p in whole if scene in ("all", SUITE.parts(p)[0])]
        solved = [_unsolved(found, some, part) < 1 for part in PARTS]
        lines.append([scene, *(f"{each.sum()} of {len(each)}" for each in solved)])
    seconds = [float(np.mean([found[p, part]["seconds"] for p in whole])) for part in PARTS]
    lines.append(["mean seconds", *(f"{each:.1f}" for each in seconds)])
    text = [f"| {' | '.join(line)} |" for line in lines]
    for part in PARTS[:-1]:
        a, b = _unsolved(found, whole, part), _unsolved(found, whole, 1)
        text.append(
            f"- only 1/{part} solves {(a < b).sum()}, only the whole side {(a > b).sum()}, "
            f"p = {sign_test(a, b):.2g}"
        )
    return "\n".join(text)


def _unsolved(found: dict[tuple[str, int], Row], problems: list[str], part: int) -> Float64:
    """1 for each problem that is not solved with that part of the side, else 0."""
    limits = [SUITE.problem(p)[0].solved for p in problems]
    reached = [found[p, part]["loss"] for p in problems]
    return np.array([float(loss > most) for loss, most in zip(reached, limits, strict=True)])


if __name__ == "__main__":
    command(__doc__ or "", planned(), measure, RESULTS, key, table)
