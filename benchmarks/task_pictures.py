"""Pictures of the tasks for docs/reference/tasks.md.

    python benchmarks/task_pictures.py san_miguel

Each picture, docs/images/TASK.png, shows one view on the left, the targets of the seeds 0, 1, 2 at
the top right, and three random candidates from the start of a search at the bottom right.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import fide_tasks

TILE = 210  # pixels; the view on the left is twice as large
GAP = 4  # pixels between images that are `joined`
LARGEST = 300_000  # bytes of a file; noise does not compress
VIEWS = {  # the one on the left, where it is not the target of seed 3
    "san_miguel": (0.017, 0.222, 0.357, 0.470, 0.039, 0.417, 0.611, 0.607),
}


def picture(name: str) -> NDArray[np.float32]:
    large = fide_tasks.make(name, 2 * TILE, seed=3)
    view = large.reference(VIEWS[name]) if name in VIEWS else large.target
    above = [fide_tasks.make(name, TILE, seed=seed).target for seed in range(3)]
    task = fide_tasks.make(name, TILE)
    candidates = np.random.default_rng(1).normal(0.5, 1 / 6, (3, task.dim)).clip(0, 1)
    below = [task.reference(x) for x in candidates]
    rows = [np.concatenate(row, axis=1) for row in (above, below)]
    return np.concatenate([view, np.concatenate(rows)], axis=1)


def joined(images: list[NDArray[np.float32]], axis: int) -> NDArray[np.float32]:
    """Images side by side or one below the other, with a white gap between them."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.ones(shape, np.float32)
    return np.concatenate([part for image in images for part in (gap, image)][1:], axis=axis)


def save(picture: NDArray[np.float32], path: Path) -> None:
    """Write a picture, (H, W, 3) in [0, 1], with as many colors as keep it below LARGEST."""
    image = full = Image.fromarray(np.rint(picture * 255).astype(np.uint8))
    for colors in (None, 256, 192, 128, 96, 64):
        if colors is not None:
            image = full.quantize(colors, kmeans=3)
        image.save(path, optimize=True)
        if path.stat().st_size < LARGEST:
            return


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", metavar="TASK", choices=fide_tasks.names("all"))
    parser.add_argument("--out", type=Path, default=Path("docs/images"), metavar="DIR")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks:
        path = arguments.out / f"{name}.png"
        save(picture(name), path)
        print(path)


if __name__ == "__main__":
    main()
