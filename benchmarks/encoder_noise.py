"""How much of a distance is noise, and how it affects the order.

Makes a table of lab/reports/encoders_quality.md:

    python benchmarks/encoder_noise.py

24 candidates of Beads from the start of a search, at 112 x 112 and 16 samples per pixel, each
rendered twice, and a third time with 128 paths as the reference.

*noise / difference*: the median distance of two renders of one candidate, divided by the median
distance of renders of different candidates.

*order*: each reference in turn is the target; Spearman's rank correlation between the distances of
the noisy renders to it and the mean squared errors of their references; the mean over the targets.

The renders are kept in runs/; the first call takes half a minute.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr

import fide_tasks
from fide_plugins import encoders, losses
from fide_plugins.types import Float32

CANDIDATES, SPP, REFERENCE_SPP = 24, 16, 128
RENDERS = Path("runs/descriptors")
LOSSES = ("mse", "loi", "perceptual")
ENCODERS = ("dense", "patch")

Matrix = NDArray[np.float64]
Distance = Callable[[Float32, Float32], Matrix]  # of images (n) from others (n), (n, n)


def renders(size: int) -> tuple[Float32, Float32, Float32]:
    """Two noisy renders of each candidate, and its reference."""
    path = RENDERS / f"beads-noise-{size}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        images: dict[str, Any] = dict(rendered(size))
        np.savez(path, **images)
    with np.load(path) as file:
        return file["one"], file["two"], file["reference"]


def rendered(size: int) -> dict[str, Float32]:
    task, fine = (fide_tasks.make("beads", size, 0, spp=spp) for spp in (SPP, REFERENCE_SPP))
    X = np.random.default_rng(0).normal(0.5, 1 / 6, (CANDIDATES, task.dim)).clip(0, 1)
    one, two, reference = (
        scene.render(X, seed=[100 * k + i for i in range(len(X))])
        for k, scene in ((1, task), (2, task), (9, fine))
    )
    return {"one": one, "two": two, "reference": reference}


def of_loss(name: str) -> Distance:
    return lambda a, b: np.array([losses.make(name, target)(a) for target in b]).T


def of_encoder(encoder: Any, power: int = 1) -> Distance:
    """Distances of all features of an encoder, or their squares."""

    def distances(a: Float32, b: Float32) -> Matrix:
        e, f = (encoder(images).flatten(1).double() for images in (a, b))
        found: Matrix = torch.cdist(e, f).numpy() ** power
        return found

    return distances


def noise_share(distances: Matrix) -> float:
    """Of distances (n, n): median of the diagonal over the median of the others."""
    others = distances[~np.eye(len(distances), dtype=bool)]
    return float(np.median(np.diag(distances)) / np.median(others))


def order(distances: Matrix, true: Matrix) -> float:
    """Mean rank correlation of columns without the diagonal, of distances (n, n) and true ones."""
    n = len(true)
    columns = [(np.delete(distances[:, j], j), np.delete(true[:, j], j)) for j in range(n)]
    return float(np.mean([spearmanr(a, b).statistic for a, b in columns]))


def measured(distance: Distance, size: int) -> tuple[float, float]:
    """Share of noise, and how well the order is kept."""
    one, two, reference = renders(size)
    true = of_loss("mse")(reference, reference)
    orders = [order(distance(noisy, reference), true) for noisy in (one, two)]
    return noise_share(distance(one, two)), float(np.mean(orders))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=112, metavar="PX")
    size = parser.parse_args().size
    torch.set_num_threads(1)
    rows = {f"loss `{name}`": of_loss(name) for name in LOSSES}
    for name in ENCODERS:
        for power, word in ((1, ""), (2, ", squared")):
            rows[f"encoder `{name}`{word}"] = of_encoder(encoders.make(name), power)
    print("| | noise / difference | order |\n|---|---:|---:|")
    for name, distance in rows.items():
        share, kept = measured(distance, size)
        print(f"| {name} | {share:.3f} | {kept:.2f} |", flush=True)


if __name__ == "__main__":
    main()
