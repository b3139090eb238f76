"""Noise of a task rendered by random paths, for docs/reference/tasks.md.

    python benchmarks/noise.py san_miguel beads --size 64
    python benchmarks/noise.py beads --losses mse loi perceptual --spp 16 64
    python benchmarks/noise.py beads --losses mse loi --spp 64 --targets 4
    python benchmarks/noise.py beads --losses perceptual --spp 1 4 8 16 --targets 4

Prints one row per number of samples per pixel: the standard error of a pixel at x_star and the mean
squared error of a render of x_star against its target, from 128 renders and all targets. Standard
errors are averaged as squares, since rare bright paths cause the noise: the plain mean would be
smaller, and smaller still with fewer renders, most of which contain no such path.
With --losses it prints one row per loss instead: mean and standard deviation over renders of
x_star, mean and minimum over candidates from the start of a search, and means over renders of two
candidates that show fewer objects: the center of the box, and x_star with all exchangeable objects
where its first one is.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_plugins import losses

FRAMES = 128  # by which the noise is measured
RENDERS = 12  # by which losses are compared
FEWER = 4  # of each candidate that shows fewer objects


def row(name: str, size: int, spp: int, targets: int) -> tuple[float, float]:
    """Standard error (root of the mean square), and mean squared error of x_star."""
    variances, squares = [], []
    for seed in range(targets):
        task = fide_tasks.make(name, size, seed, spp=spp)
        x = task.x_star
        if x is None:
            raise SystemExit(f"the target of {name} has no known parameters")
        frames = task.render(np.tile(x, (FRAMES, 1))).astype(np.float64)
        variances.append(frames.var(axis=0, ddof=1).mean())
        squares.append(np.square(frames - task.target).mean())
    return float(np.sqrt(np.mean(variances))), float(np.mean(squares))


def contrast(name: str, size: int, spp: int, seed: int, names: list[str]) -> list[str]:
    """Losses of x_star, of candidates of the first generation, and of those with fewer objects."""
    task = fide_tasks.make(name, size, seed, spp=spp)
    x = task.x_star
    if x is None:
        raise SystemExit(f"the target of {name} has no known parameters")
    start = np.random.default_rng(0).normal(0.5, 1 / 6, (RENDERS, task.dim)).clip(0, 1)
    repeated = [(x, RENDERS), (np.full(task.dim, 0.5), FEWER), (in_one_place(task, x), FEWER)]
    sets = [np.tile(each, (n, 1)) for each, n in repeated]
    images = [task.render(X, seed=i) for i, X in enumerate([*sets, start])]
    rows = []
    for loss in names:
        measure = losses.make(loss, task.target)
        truth, center, one, others = (np.asarray(measure(each)) for each in images)
        cells = [loss, f"{spp}", f"{seed}", f"{truth.mean():.4f} ± {truth.std():.4f}"]
        cells += [f"{v:.4f}" for v in (others.mean(), others.min(), center.mean(), one.mean())]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def in_one_place(task: Any, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point x (dim,) with all exchangeable objects equal to the first one."""
    groups = np.array([p.group for p in task.parameters])
    moved = x.copy()
    for group in set(groups):
        if task.alike is not None and group.split()[0] == task.alike:
            moved[groups == group] = x[groups == f"{task.alike} 1"]
    return moved


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names())
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 16, 64], metavar="N")
    parser.add_argument("--targets", type=int, help="default: 3, and 1 with --losses")
    parser.add_argument("--losses", nargs="+", default=[], choices=losses.names(), metavar="LOSS")
    arguments = parser.parse_args()
    for name in arguments.tasks:
        if arguments.losses:
            print("| loss | paths | seed | x* | start | lowest | center | one place |", flush=True)
            for seed in range(arguments.targets or 1):
                for spp in arguments.spp:
                    rows = contrast(name, arguments.size, spp, seed, arguments.losses)
                    print("\n".join(rows), flush=True)
            continue
        renderer = getattr(fide_tasks.make(name, arguments.size), "renderer", "")
        print(f"{name} {renderer} | samples per pixel | standard error | MSE of x*", flush=True)
        for spp in arguments.spp:
            error, square = row(name, arguments.size, spp, arguments.targets or 3)
            print(f"| {spp} | {error:.3f} | {square:.4f} |", flush=True)


if __name__ == "__main__":
    main()
