"""Loss around the true parameters of a task, for docs/reference/tasks.md.

    python benchmarks/landscape.py san_miguel --task-seeds 0 2

Prints one line per target and loss: the median loss of candidates that are Gaussian around x_star,
by the standard deviation in every parameter, and of candidates that are uniform in the box.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_plugins import losses

DEVIATIONS = (0.0, 0.003, 0.01, 0.03, 0.06, 0.1, 0.17)


def landscape(task: fide_tasks.Task, loss: str, candidates: int) -> list[float]:
    """Median loss at each of DEVIATIONS, then of uniform candidates."""
    measure = losses.make(loss, task.target)

    def median(X: NDArray[np.float64]) -> float:
        return float(np.median(np.asarray(measure(task.render(X.clip(0, 1))))))

    center = task.x_star
    if center is None:
        raise SystemExit(f"the target of {task.name} has no known parameters")
    near = np.random.default_rng(1).normal(0, 1, (candidates, task.dim))
    uniform = np.random.default_rng(0).random((5 * candidates, task.dim))
    return [median(center + s * near) for s in DEVIATIONS] + [median(uniform)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", metavar="TASK", choices=fide_tasks.names())
    parser.add_argument("--losses", nargs="+", default=["mse", "perceptual", "loi"])
    parser.add_argument("--task-seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--candidates", type=int, default=60)
    arguments = parser.parse_args()
    print("seed loss".ljust(20), *(f"{s:<7g}" for s in DEVIATIONS), "uniform")
    for seed in arguments.task_seeds:
        task = fide_tasks.make(arguments.task, arguments.size, seed)
        for loss in arguments.losses:
            row = landscape(task, loss, arguments.candidates)
            print(f"{seed} {loss}".ljust(20), *(f"{value:<7.4f}" for value in row), flush=True)


if __name__ == "__main__":
    main()
