"""Noise of a task rendered by random paths, for docs/reference/tasks.md.

    python benchmarks/noise.py san_miguel beads --size 64
    python benchmarks/noise.py beads --losses mse loi perceptual --spp 16 64

Prints one row per number of paths per pixel: the standard error of a pixel at x_star and the mean
squared error of a render of x_star against its target, from 128 renders and all targets. Standard
errors are averaged as squares, since rare bright paths cause the noise: the plain mean would be
smaller, and smaller still with fewer renders, most of which contain no such path.
With --losses it prints one row per loss instead: mean and standard deviation over renders of
x_star, and mean and minimum over candidates from the start of a search, for the target of seed 0.
"""

from __future__ import annotations

import argparse

import numpy as np

import fide_tasks
from fide_plugins import losses

FRAMES = 128  # by which the noise is measured
RENDERS = 12  # by which losses are compared


def row(name: str, size: int, spp: int, targets: int) -> tuple[float, float]:
    """Standard error (root of the mean square), and mean squared error of x_star."""
    variances, squares = [], []
    for seed in range(targets):
        task = fide_tasks.make(name, size, seed, spp=spp)
        x = task.x_star
        if x is None:
            raise SystemExit(f"the target of {name} has no known parameters")
        frames = task.render(np.tile(x, (FRAMES, 1))).astype(np.float64)
        variances.append(frames.var(axis=0, ddof=1).mean())  # that of Task.noise_level, squared
        squares.append(np.square(frames - task.target).mean())
    return float(np.sqrt(np.mean(variances))), float(np.mean(squares))


def contrast(name: str, size: int, spp: int, loss: str) -> str:
    """Losses of x_star, and of candidates of the first generation."""
    task = fide_tasks.make(name, size, 0, spp=spp)
    measure = losses.make(loss, task.target)
    x = task.x_star
    if x is None:
        raise SystemExit(f"the target of {name} has no known parameters")
    start = np.random.default_rng(0).normal(0.5, 1 / 6, (RENDERS, task.dim)).clip(0, 1)
    truth = np.asarray(measure(task.render(np.tile(x, (RENDERS, 1)))))
    others = np.asarray(measure(task.render(start)))
    found = f"{truth.mean():.4f} ± {truth.std():.4f}"
    return f"| {loss} | {spp} | {found} | {others.mean():.4f} | {others.min():.4f} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names())
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 16, 64], metavar="N")
    parser.add_argument("--targets", type=int, default=3)
    parser.add_argument("--losses", nargs="+", default=[], choices=losses.names(), metavar="LOSS")
    arguments = parser.parse_args()
    for name in arguments.tasks:
        for loss in arguments.losses:
            for spp in arguments.spp:
                print(contrast(name, arguments.size, spp, loss), flush=True)
        if arguments.losses:
            continue
        renderer = getattr(fide_tasks.make(name, arguments.size), "renderer", "")
        print(f"{name} {renderer} | paths a pixel | standard error | MSE of x*", flush=True)
        for spp in arguments.spp:
            error, square = row(name, arguments.size, spp, arguments.targets)
            print(f"| {spp} | {error:.3f} | {square:.4f} |", flush=True)


if __name__ == "__main__":
    main()
