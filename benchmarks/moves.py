"""Renders until a scene is solved: how well the moves find the global optimum.

    python benchmarks/moves.py voronoi8 robot --targets 40-49 --seeds 0-1 --out runs/moves.jsonl
    python benchmarks/moves.py --table runs/moves.jsonl
    python benchmarks/moves.py --losses benchmarks/results/many.jsonl

Every run (scene, target, seed, configuration) is one line of the output file, appended when it is
done; a second call does what is missing. A run ends when its scene is solved or its budget spent.
A configuration is an optimizer with options, `--configuration NAME OPTIMIZER key=value ...`.
`results/coarse.jsonl` has FIDE with and without coarse to fine, `results/lines.jsonl` thin lines
before and after the move *rearrange*. `results/many.jsonl` rivals where
there are 160 parameters and more.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from rows import Row, read, run_missing

import fide_tasks
from fide_lab import optimizers
from fide_plugins import FIDE
from fide_plugins.validation.options import parse_key_value

MARKS = (250, 500, 1000, 2000, 4000, 5000, 10_000, 25_000, 50_000)

Render = Callable[[NDArray[np.float64]], NDArray[np.float32]]


class Scene(NamedTuple):
    """A task with its options, the loss at which it is solved, and the renders it may take.

    size: pixels of a side.
    """

    task: str
    options: dict[str, Any]
    solved: float
    budget: int
    size: int = 112


SCENES = {
    "voronoi8": Scene("voronoi", {}, 1e-3, 4000),
    "voronoi12": Scene("voronoi", {"cells": 12}, 1e-3, 10_000),
    "voronoi16": Scene("voronoi", {"cells": 16}, 1e-3, 10_000),
    "voronoi32": Scene("voronoi", {"cells": 32}, 1e-3, 50_000),
    "robot": Scene("robot", {}, 2e-5, 5000),
    "spline": Scene("spline", {"target": "random"}, 1e-3, 5000),
    "two_cells": Scene("voronoi", {"variant": "distance"}, 1e-6, 2000),
    "triangles10": Scene("triangles", {"triangles": 10}, 1e-3, 5000, 64),
    "triangles30": Scene("triangles", {"triangles": 30}, 1e-3, 5000, 64),
    "triangles100": Scene("triangles", {"triangles": 100}, 1e-3, 5000, 64),
    "triangles400": Scene("triangles", {"triangles": 400}, 1e-3, 5000, 64),
    "sheets": Scene("sheets", {}, 1e-4, 4000),
    "lamps": Scene("lamps", {}, 1e-5, 5000, 64),
    "sprites": Scene("sprites", {}, 1e-3, 5000, 64),
    "stick_figure": Scene("stick_figure", {}, 1e-5, 5000, 64),
    "arm": Scene("arm", {}, 1e-6, 5000, 64),
    "lens": Scene("lens", {}, 1e-5, 5000, 64),
    "ball": Scene("ball", {}, 1e-6, 2000, 64),
}


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    if arguments.losses:
        print(losses(read(arguments.losses)))
        return
    measured = partial(run, optimizer=arguments.optimizer, options=arguments.options)
    run_missing(planned_runs(arguments), measured, arguments.out, key)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--targets", type=span, default=range(40, 50), metavar="A-B")
    parser.add_argument("--seeds", type=span, default=range(1), metavar="A-B")
    parser.add_argument(
        "--configuration",
        nargs="+",
        default=["balanced", "fide"],
        metavar="NAME",
        help="a name for the table, the optimizer, and its options as key=value",
    )
    parser.add_argument("--budget", type=int, default=None)
    parser.add_argument("--size", type=int, default=None, help="pixels of a side")
    parser.add_argument("--out", type=Path, default=Path("runs/moves.jsonl"))
    parser.add_argument("--table", type=Path)
    parser.add_argument("--losses", type=Path)
    arguments = parser.parse_args()
    unknown = set(arguments.scenes) - set(SCENES)
    if unknown:
        parser.error(f"a scene is one of {', '.join(SCENES)}, not {', '.join(sorted(unknown))}")
    arguments.configuration, *rest = arguments.configuration
    arguments.optimizer, *pairs = rest or ["fide"]
    arguments.options = dict(parse_key_value(pair) for pair in pairs)
    return arguments


def span(text: str) -> range:
    """A range such as 40-49, or one number."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def planned_runs(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in arguments.seeds:
        for scene in arguments.scenes:
            for target in arguments.targets:
                yield {
                    "scene": scene,
                    "target": target,
                    "seed": seed,
                    "configuration": arguments.configuration,
                    "size": arguments.size or SCENES[scene].size,
                    "budget": arguments.budget or SCENES[scene].budget,
                }


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return tuple(
        row[name] for name in ("scene", "target", "seed", "configuration", "size", "budget")
    )


def run(planned_run: Row, optimizer: str, options: dict[str, Any]) -> Row:
    """One run: when it was solved, and its best loss at every mark."""
    scene = SCENES[planned_run["scene"]]
    dim, target, render = make(scene, planned_run["size"], planned_run["target"])
    opt = optimizers.make(optimizer, dim, target, seed=planned_run["seed"], **options)
    best, solved_at, seconds = np.inf, None, 0.0
    marks: dict[str, float] = {}
    while opt.evaluations < planned_run["budget"] and solved_at is None:
        began = time.process_time()
        X = opt.ask_ready()  # as the run loop does: steps come one at a time
        seconds += time.process_time() - began
        images = render(X)
        losses = np.square(images - target, dtype=np.float64).mean(axis=(1, 2, 3))
        left = planned_run["budget"] - opt.evaluations  # the last generation may go beyond it
        for i, loss in enumerate(losses[:left].tolist(), opt.evaluations + 1):
            best = min(best, loss)
            marks |= {str(i): best} if i in MARKS else {}
            solved_at = i if solved_at is None and best <= scene.solved else solved_at
        # FIDE compares images itself, as in `fit`: told losses would keep it from blurring them.
        began = time.process_time()
        opt.tell(X, images, *([] if isinstance(opt, FIDE) else [losses]))
        seconds += time.process_time() - began
    believed = float(np.square(render(opt.recommend()[None])[0] - target).mean())
    times = {name: round(1e3 * s / opt.evaluations, 3) for name, s in opt.times.items()}
    return {
        **planned_run,
        "solved_at": solved_at,
        "best": best,
        "marks": marks,
        "recommended": believed,
        "overhead_ms": times,
        "cpu_ms": round(1e3 * seconds / opt.evaluations, 3),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,  # of the process
    }


def make(scene: Scene, size: int, seed: int) -> tuple[int, NDArray[np.float32], Render]:
    """Number of parameters, target and renderer of a scene."""
    if scene.task == "sheets":
        return sheets(size, seed)
    task = fide_tasks.make(scene.task, size, seed, **scene.options)
    return task.dim, task.target, task.render


def sheets(size: int, seed: int) -> tuple[int, NDArray[np.float32], Render]:
    """Three large ellipses, painted over each other in the order of their parameters.

    Nine parameters each: x, y, two axes, angle, color and opacity. Nothing is redundant.
    """
    rng = np.random.default_rng((seed, 3))

    def render(X: NDArray[np.float64]) -> NDArray[np.float32]:
        return np.stack([_sheet(x.reshape(3, 9), size) for x in X])

    x_star = rng.uniform(0.15, 0.85, 27)
    return 27, render(x_star[None])[0], render


def _sheet(things: NDArray[np.float64], size: int) -> NDArray[np.float32]:
    frame = np.full((size, size, 3), 0.9, np.float32)
    numbers: list[list[float]] = things.tolist()
    for x, y, a, b, angle, *color, opacity in numbers:
        mask = np.zeros((size, size), np.uint8)
        center = (round(x * size * 16), round(y * size * 16))
        axes = (round((0.15 + 0.35 * a) * size * 16), round((0.15 + 0.35 * b) * size * 16))
        points = np.asarray(cv2.ellipse2Poly((0, 0), axes, 0, 0, 360, 6), np.float64)
        turn = np.pi * angle
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        outline = np.rint(points @ rotation + center).astype(np.int32)
        cv2.fillPoly(mask, [outline], 255, cv2.LINE_AA, 4)
        alpha = (mask / np.float32(255) * np.float32(0.5 + 0.5 * opacity))[:, :, None]
        frame += alpha * (np.array(color, np.float32) - frame)
    return frame


def table(rows: list[Row]) -> str:
    """Median of renders until a scene is solved, and runs solved by each mark, in Markdown."""
    marks = " | ".join(f"{mark:,}" for mark in MARKS)
    lines = [
        f"| scene | configuration | px | runs | median | {marks} |",
        "|---|---|" + "---:|" * (3 + len(MARKS)),
    ]
    names = ("scene", "configuration", "size", "budget")
    for kind in dict.fromkeys(tuple(row[name] for name in names) for row in rows):
        group = [row for row in rows if tuple(row[name] for name in names) == kind]
        scene, configuration, size, budget = kind
        at = [row["solved_at"] or np.inf for row in group]
        counts = [sum(n <= mark for n in at) if mark <= budget else "" for mark in MARKS]
        line = (scene, configuration, size, len(group), f"{np.median(at):.0f}", *counts)
        lines.append(f"| {' | '.join(map(str, line))} |")
    return "\n".join(lines)


def losses(rows: list[Row]) -> str:
    """Median losses, on how many targets FIDE's is lower, and costs, in Markdown.

    At the end a run has the lower loss of its best candidate and of what it recommends.
    """
    columns = ("1,000", "2,000", "end", "FIDE lower at 1,000, 2,000, end", "CPU ms", "peak MB")
    lines = [
        f"| scene | optimizer | targets | {' | '.join(columns)} |",
        "|---|---|" + "---:|" * (1 + len(columns)),
    ]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        group = [row for row in rows if row["scene"] == scene]
        fide = {row["target"]: at_marks(row) for row in group if row["configuration"] == "FIDE"}
        for name in dict.fromkeys(row["configuration"] for row in group):
            mine = [row for row in group if row["configuration"] == name]
            at = np.array([at_marks(row) for row in mine])
            shared = [(at_marks(row), fide[row["target"]]) for row in mine if row["target"] in fide]
            lower = np.sum([np.array(ours) < theirs for theirs, ours in shared], axis=0)
            of = "" if name == "FIDE" else ", ".join(map(str, lower)) + f" of {len(shared)}"
            cost = (f"{np.median([row[key] for row in mine]):.3g}" for key in ("cpu_ms", "peak_mb"))
            medians = ("-" if loss == np.inf else f"{loss:.3g}" for loss in np.median(at, axis=0))
            lines.append(f"| {' | '.join([scene, name, str(len(mine)), *medians, of, *cost])} |")
    return "\n".join(lines)


def at_marks(row: Row) -> list[float]:
    """Losses of a run after 1,000 and 2,000 renders, and at its end."""
    end = min(row["best"], row["recommended"])
    return [row["marks"].get("1000", np.inf), row["marks"].get("2000", np.inf), end]


if __name__ == "__main__":
    main()
