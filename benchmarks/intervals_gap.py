"""Counts how often the truth lies in the interval of `fit`, also of pictures that no render equals.

    python benchmarks/intervals_gap.py              # the runs that are missing
    python benchmarks/intervals_gap.py --table

A soft disk and a soft square in front of it, five parameters, 48 x 48 pixels in color; 100 targets.
Without a gap: independent noise (0.03), and rounding to 8 bits.  With one: another exposure (gamma
1.35), shading (a smooth gain of 0.65 to 1.3), an occluder (a quarter of each side, random colors),
a camera (blur and noise); 25 targets each.  Intervals are best.x +- std and +- 1.96 std, of each
parameter; beside them those of samples of the search, without renders around the answer.

Each run is one line of benchmarks/results/intervals_gap.jsonl.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, read, run_missing
from scipy.ndimage import gaussian_filter, zoom

from fide_plugins import Float, Space, fit
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results" / "intervals_gap.jsonl"
RUNS = {"noise": 100, "8 bits": 100, "exposure": 25, "shading": 25, "occluder": 25, "camera": 25}
SIDE, BUDGET = 48, 800
SPACE = Space(
    x=Float(0, 1), y=Float(0, 1), radius=Float(0.05, 0.4), left=Float(0, 1), top=Float(0, 1)
)
V, U = np.mgrid[0:SIDE, 0:SIDE] / (SIDE - 1)
GROUND, DISK, SQUARE = np.array([[0.15, 0.25, 0.4], [0.85, 0.5, 0.3], [0.2, 0.8, 0.3]])


def draw(p: dict[str, float]) -> Float64:
    """Picture (H, W, 3)."""
    disk = 1 / (1 + np.exp(30 * (np.hypot(U - p["x"], V - p["y"]) - p["radius"])))
    square = np.maximum(abs(U - p["left"]), abs(V - p["top"])) - 0.12
    image = GROUND + disk[..., None] * (DISK - GROUND)
    covered = 1 / (1 + np.exp(30 * square))[..., None]
    return np.asarray(image + covered * (SQUARE - image), np.float64)


def changed(image: Float64, gap: str, rng: np.random.Generator) -> Float64:
    """The picture (H, W, 3) as it was taken."""
    if gap == "8 bits":
        return np.asarray(np.round(255 * image) / 255, np.float64)
    if gap == "exposure":
        image = 0.9 * (0.85 * image) ** 1.35 + 0.04
    elif gap == "shading":
        image = image * zoom(rng.uniform(0.65, 1.3, (3, 3)), SIDE / 3, order=2)[..., None]
    elif gap == "occluder":
        row, column = rng.integers(0, SIDE - 14), rng.integers(0, SIDE - 12)
        image[row : row + 14, column : column + 12] = zoom(
            rng.uniform(0, 1, (7, 6, 3)), (2, 2, 1), order=1
        )
    elif gap == "camera":
        image = gaussian_filter(image, (0.6, 0.6, 0)) + rng.normal(0, 0.03, image.shape)
    else:
        image = image + rng.normal(0, 0.03, image.shape)
    return np.asarray(np.clip(image, 0, 1), np.float64)


def cells(runs: int | None) -> Iterator[Row]:
    """All runs."""
    for gap, number in RUNS.items():
        for seed in range(runs or number):
            yield {"gap": gap, "seed": seed}


def run(cell: Row) -> Row:
    """One row."""
    rng = np.random.default_rng((cell["seed"], 5))
    truth = rng.uniform([0.3, 0.3, 0.3, 0.25, 0.25], [0.7, 0.7, 0.7, 0.75, 0.75])
    target = changed(draw(SPACE.decode(truth)), cell["gap"], rng)
    found = fit(draw, target, SPACE, budget=BUDGET, workers=0, seed=cell["seed"])
    assert found.best is not None and found.best.std is not None and found.optimizer is not None
    by_samples = found.optimizer.best
    samples = None if by_samples is None else by_samples.std
    return {
        **cell,
        "stopped": found.stopped,
        "evaluations": found.evaluations,
        "error": [float(f"{x:.3g}") for x in np.abs(found.best.x - truth)],
        "std": [float(f"{x:.3g}") for x in found.best.std],
        "of_samples": None if samples is None else [float(f"{x:.3g}") for x in samples],
    }


def table(rows: list[Row]) -> str:
    """Coverage of each kind of picture, and of all with a gap."""
    head = "| picture | runs | in 1 std | in 1.96 std | of samples: in 1 std | in 1.96 std |"
    lines = [head, "|---" * 6 + "|"]
    gaps = list(RUNS)[2:]
    for name, kinds in [*((kind, [kind]) for kind in RUNS), ("all with a gap", gaps)]:
        own = [row for row in rows if row["gap"] in kinds]
        known = [row for row in own if row["of_samples"] is not None]
        held = [*_held(own, "std"), *_held(known, "of_samples")]
        lines.append(f"| {name} | {len(own)} | {' | '.join(held)} |")
    return "\n".join(lines)


def _held(rows: list[Row], what: str) -> list[str]:
    if not rows:
        return ["-", "-"]
    error, std = (np.array([row[name] for row in rows]) for name in ("error", what))
    return [f"{(error <= width * std).mean():.0%}" for width in (1.0, 1.96)]


def main() -> None:
    """Do the runs that are missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--runs", type=int, help="of each kind of picture")
    arguments: Any = parser.parse_args()
    if not arguments.table:
        run_missing(cells(arguments.runs), run, RESULTS, lambda row: (row["gap"], row["seed"]))
    print(table(read(RESULTS)))


if __name__ == "__main__":
    main()
