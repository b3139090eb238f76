"""Nevergrad's `minimize` with FIDE on a Dask cluster: workers render, this process searches.

Two worker processes on this machine replace a cluster; use ``Client("tcp://scheduler:8786")`` for a
real one.  Large images on a shared disk can be passed by name, ``ImageLoss(loss, path)``.
"""

from __future__ import annotations

import nevergrad as ng
import numpy as np
from distributed import Client, LocalCluster

import fide_tasks
from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE

BUDGET, WORKERS = 200, 2


def objective(**parameters: float) -> ImageLoss:
    """Loss and image of four Voronoi cells; runs in a worker."""
    task = fide_tasks.make("voronoi", cells=4, size=64, seed=0)
    x = np.array([parameters[f"p{i}"] for i in range(task.dim)])
    image = task.render(x[None])[0]
    return ImageLoss(float(((image - task.target) ** 2).mean()), image)


def main() -> None:
    task = fide_tasks.make("voronoi", cells=4, size=64, seed=0)
    parametrization = ng.p.Instrumentation(
        **{f"p{i}": ng.p.Scalar(lower=0, upper=1) for i in range(task.dim)}
    )
    parametrization.random_state.seed(0)
    optimizer = ParametrizedFIDE(target=task.target)(parametrization, BUDGET, WORKERS)
    settings = {"n_workers": WORKERS, "threads_per_worker": 1, "dashboard_address": ":0"}
    with LocalCluster(**settings) as cluster, Client(cluster) as client:  # type: ignore[no-untyped-call]
        best = optimizer.minimize(objective, executor=client.get_executor(pure=False))
    print(f"MSE {best.loss:.5f} after {optimizer.num_tell} renders by {WORKERS} workers")


if __name__ == "__main__":
    main()
