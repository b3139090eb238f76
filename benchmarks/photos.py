"""Photographs by 60 Voronoi cells: the loss of `fide fit`, beside that of a grid of mean colors.

    python benchmarks/photos.py --out benchmarks/results/photos.jsonl
    python benchmarks/photos.py --table benchmarks/results/photos.jsonl

Three photographs that come with matplotlib and scikit-learn, fitted by the command, four seeds
each, from the start that it reads off the picture and from the center of the box; and CMA-ES from
the center.  The grid has as many fields as there are cells, 10 along the longer side and 6 along
the shorter one, each in its mean color: what is had without any search.  Every run is one line of
the output file; a second call does the missing runs.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import matplotlib
import numpy as np
from moves import span
from PIL import Image
from rows import Row, read, run_missing

from fide_plugins.cli import main as fide
from fide_plugins.types import Float32
from fide_plugins.validation import images

SIZE, CELLS, BUDGET = 112, 60, 5000
MARKS = ("1", "1000", "2000", "4000", "5000")
CONFIGURATIONS = {
    "FIDE, start read off the picture": ("--start", "picture"),
    "FIDE, start in the center": ("--start", "center"),
    "CMA-ES, start in the center": ("--optimizer", "cma", "--start", "center"),
}


def hopper() -> Image.Image:
    """Portrait that comes with matplotlib."""
    path = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    return Image.open(path).convert("RGB")


def of_scikit_learn(name: str) -> Callable[[], Image.Image]:
    """Photograph that comes with scikit-learn."""

    def photo() -> Image.Image:
        from sklearn.datasets import load_sample_image

        return Image.fromarray(load_sample_image(f"{name}.jpg"))

    return photo


PHOTOS = {"hopper": hopper, "china": of_scikit_learn("china"), "flower": of_scikit_learn("flower")}


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=span, default=range(4), metavar="A-B")
    parser.add_argument("--out", type=Path, default=Path("runs/photos.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(runs(arguments.seeds), measure, arguments.out, key)


def runs(seeds: range) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in seeds:
        for photo in PHOTOS:
            for configuration in CONFIGURATIONS:
                yield {"photo": photo, "configuration": configuration, "seed": seed}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["photo"], row["configuration"], row["seed"]


def measure(planned: Row) -> Row:
    """One run of `fide fit`: losses after numbers of renders."""
    with tempfile.TemporaryDirectory() as folder:
        picture, out = f"{folder}/{planned['photo']}.png", f"{folder}/run"
        PHOTOS[planned["photo"]]().save(picture)
        words = ["fit", picture, "--model", "voronoi", "--cells", CELLS, "--size", SIZE,
                 "--budget", BUDGET, "--seed", planned["seed"], "--out", out,
                 *CONFIGURATIONS[planned["configuration"]]]  # fmt: skip
        if fide([str(word) for word in words]) != 0:
            raise RuntimeError(f"fide {words} failed")
        with open(f"{out}/curve.csv", newline="") as file:
            best = [float(line["best_loss"]) for line in csv.DictReader(file)]
        grid = grid_loss(images.load(picture, max_side=SIZE))
    return {**planned, "best": {mark: best[int(mark) - 1] for mark in MARKS}, "grid": grid}


def grid_loss(picture: Float32) -> float:
    """Mean squared error of 60 fields of the picture (H, W, 3), each in its mean color."""
    height, width = picture.shape[:2]
    fields = (10, 6) if width > height else (6, 10)
    means = cv2.resize(picture, fields, interpolation=cv2.INTER_AREA)
    drawn = cv2.resize(means, (width, height), interpolation=cv2.INTER_NEAREST)
    return float(np.square(drawn.astype(np.float64) - picture).mean())


def table(rows: list[Row]) -> str:
    """Median losses, in Markdown."""
    lines = ["| photograph | | runs | " + " | ".join(f"{int(m):,}" for m in MARKS) + " | of grid |"]
    lines.append("|---|---|---:|" + "---:|" * (len(MARKS) + 1))
    for photo, configuration in dict.fromkeys((r["photo"], r["configuration"]) for r in rows):
        group = [r for r in rows if (r["photo"], r["configuration"]) == (photo, configuration)]
        best = [statistics.median(row["best"][mark] for row in group) for mark in MARKS]
        cells = " | ".join(f"{loss:.4f}" for loss in best)
        share = best[-1] / group[0]["grid"]
        lines.append(f"| {photo} | {configuration} | {len(group)} | {cells} | {share:.2f} |")
    grids = dict.fromkeys((r["photo"], r["grid"]) for r in rows)
    lines += [
        f"| {photo} | grid of 6 x 10 mean colors | | | | | | {g:.4f} | 1 |" for photo, g in grids
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
