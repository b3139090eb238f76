"""How near the candidates with the nearest images are to the parameters of the target.

    python benchmarks/nearest.py san_miguel robot

The script draws uniform candidates and takes the twenty whose images are nearest to the target, by
each loss and by features: the tokens of `dense`, and their means and deviations over regions of the
image, which do not contain positions inside a region.  It compares their distance from x_star in
every parameter with that of all candidates: 1 means no nearer, 0 means equal to x_star.  Medians
over the twenty, mean over parameters and targets.  All targets share the candidates' renders.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_plugins import encoders, losses

NEAREST = 20
PARTS = (1, 2, 4)  # along a side
CYCLIC = {"san_miguel": [4]}  # parameters that are directions: 0 and 1 are the same


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names())
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--candidates", type=int, default=3000)
    parser.add_argument("--targets", type=int, default=12)
    arguments = parser.parse_args()
    for name in arguments.tasks:
        tasks = [fide_tasks.make(name, arguments.size, seed) for seed in range(arguments.targets)]
        X = np.random.default_rng(0).random((arguments.candidates, tasks[0].dim))
        images = tasks[0].render(X, seed=0)
        targets = np.stack([task.target for task in tasks])
        truth = np.array([task.x_star for task in tasks])
        for measure, distance in distances(images, targets).items():
            print(f"{name:12s} {measure:24s} {nearness(X, truth, distance, name):.2f}", flush=True)


def distances(
    images: NDArray[np.float32], targets: NDArray[np.float32]
) -> dict[str, NDArray[np.float64]]:
    """Of every image to every target, (targets, candidates), by each measure."""
    found = {
        name: np.array([losses.make(name, target)(images) for target in targets], np.float64)
        for name in ("mse", "perceptual", "loi")
    }
    encoder = encoders.make("dense")
    of_images, of_targets = (encoder(batch).double().numpy() for batch in (images, targets))
    found["tokens"] = squares(of_images, of_targets)
    for parts in PARTS:
        pooled = [pool(tokens, parts) for tokens in (of_images, of_targets)]
        found[f"tokens, {parts} x {parts} parts"] = squares(*pooled)
    return found


def pool(tokens: NDArray[np.float64], parts: int) -> NDArray[np.float64]:
    """Means and deviations (n, parts^2, 2 C) of square grids of tokens (n, T, C)."""
    n, count, channels = tokens.shape
    side = round(count**0.5)
    grid = tokens.reshape(n, side, side, channels)
    blocks = [
        block.reshape(n, -1, channels)
        for row in np.array_split(grid, parts, axis=1)
        for block in np.array_split(row, parts, axis=2)
    ]
    return np.stack(
        [np.concatenate([b.mean(axis=1), b.std(axis=1)], axis=1) for b in blocks], axis=1
    )


def squares(images: NDArray[np.float64], targets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances (targets, candidates) of features, each in units of its deviation."""
    scale = images.std(axis=0) + 1e-9
    return np.array([(((images - target) / scale) ** 2).sum(axis=(1, 2)) for target in targets])


def nearness(
    X: NDArray[np.float64], truth: NDArray[np.float64], distance: NDArray[np.float64], name: str
) -> float:
    """Median distance of the nearest candidates' parameters, over that of all."""
    ratios = []
    for x_star, d in zip(truth, distance, strict=True):
        off = np.abs(X - x_star)
        for i in CYCLIC.get(name, []):
            off[:, i] = np.minimum(off[:, i], 1 - off[:, i])
        ratios.append(np.median(off[np.argsort(d)[:NEAREST]], axis=0) / np.median(off, axis=0))
    return float(np.mean(ratios))


if __name__ == "__main__":
    main()
