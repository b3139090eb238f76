"""FIDE with uninformative images compared with CMA-ES without images.

Makes a table of docs/reference/nevergrad.md:

    python benchmarks/nevergrad_uninformative.py

The loss is that of eight Voronoi cells (40 parameters).  The image is the true one, the same gray
image for all candidates, or new noise.  CMA-ES is FIDE with the same losses and no images.  Seeds
are paired: a search and its comparison start with the same candidates.  The table shows the ratio
of the best loss after the budget to that of CMA-ES: its geometric mean over seeds, and the value
that 95 % of resamplings of the seeds stay below.  Every search is one line of the output file; a
second call does the missing ones.
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import nevergrad as ng
import numpy as np
from rows import Row, read, run_missing

import fide_tasks
from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE

KINDS = ("none", "true", "constant", "noise")


def run(kind: str, seed: int, budget: int, size: int) -> float:
    """Best loss of one search."""
    task = fide_tasks.make("voronoi", size=size, seed=seed % 4)
    rng = np.random.default_rng([seed, 1])
    gray = np.full(task.target.shape, 0.5, np.float32)
    pictures: dict[str, Callable[[Any], Any]] = {
        "none": lambda image: None,
        "true": lambda image: image,
        "constant": lambda image: gray,
        "noise": lambda image: rng.random(image.shape, dtype=np.float32),
    }

    def objective(x: Any) -> ImageLoss:
        image = task.render(x[None])[0]
        return ImageLoss(float(((image - task.target) ** 2).mean()), pictures[kind](image))

    parametrization = ng.p.Array(shape=(task.dim,), lower=0, upper=1)
    optimizer = ParametrizedFIDE(target=task.target, seed=seed)(parametrization, budget)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return float(optimizer.minimize(objective).loss)


def cells(seeds: int, budget: int, size: int) -> Iterator[Row]:
    """All searches, seeds outermost."""
    for seed in range(seeds):
        for kind in KINDS:
            yield {"kind": kind, "seed": seed, "budget": budget, "size": size}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a search."""
    return row["kind"], row["seed"], row["budget"], row["size"]


def compare(ratios: Any) -> tuple[float, float]:
    """Geometric mean, and its upper bound at 95 %, of paired ratios (n,)."""
    logs = np.log(ratios)
    resampled = np.random.default_rng(0).choice(logs, (10_000, len(logs))).mean(axis=1)
    return float(np.exp(logs.mean())), float(np.exp(np.quantile(resampled, 0.95)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--budget", type=int, default=1500)
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--out", type=Path, default=Path("runs/nevergrad_uninformative.jsonl"))
    options = parser.parse_args()
    settings = options.budget, options.size
    run_missing(
        cells(options.seeds, *settings),
        lambda cell: {**cell, "loss": run(**cell)},
        options.out,
        key,
    )
    known = {key(row): row["loss"] for row in read(options.out)}
    for kind in KINDS[1:]:
        losses, others = (
            np.array([known[each, seed, *settings] for seed in range(options.seeds)])
            for each in (kind, "none")
        )
        mean, bound = compare(losses / others)
        print(f"{kind:8} loss over that of CMA-ES: {mean:.2f}, at most {bound:.2f} (95 %)")


if __name__ == "__main__":
    main()
