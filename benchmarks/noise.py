"""Noise of a task that is rendered by random paths, for docs/tasks.md.

    python benchmarks/noise.py beads

One row for each number of paths a pixel: the standard error of a pixel at x_star, averaged over the
image and the targets, and the mean squared error of a render of x_star against its target.
"""

from __future__ import annotations

import argparse

import numpy as np

import fide_tasks


def row(name: str, size: int, spp: int, targets: int) -> tuple[float, float]:
    """Mean standard error, and mean squared error of x_star."""
    errors, squares = [], []
    for seed in range(targets):
        task = fide_tasks.make(name, size, seed, spp=spp)
        x = task.x_star
        if x is None:
            raise SystemExit(f"the target of {name} has no known parameters")
        errors.append(task.noise_level(x, frames=8).mean())
        squares.append(np.square(task.render(x[None])[0] - task.target).mean())
    return float(np.mean(errors)), float(np.mean(squares))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names())
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 16, 64], metavar="N")
    parser.add_argument("--targets", type=int, default=3)
    arguments = parser.parse_args()
    for name in arguments.tasks:
        print(f"{name} | paths a pixel | standard error | MSE of x*", flush=True)
        for spp in arguments.spp:
            error, square = row(name, arguments.size, spp, arguments.targets)
            print(f"| {spp} | {error:.3f} | {square:.4f} |", flush=True)


if __name__ == "__main__":
    main()
