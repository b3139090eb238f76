"""Measure the mean and the variance of noisy renders, for tests/tasks/test_noise.py to compare to.

    python tests/data/noise_reference.py beads

writes tests/data/beads_noise.npz: x (dim,), the parameters of the target of seed 0; mean and
variance (H, W, 3) of single frames at that x, in units of the image; frames, size, spp. It takes a
minute or two. To be run again when a scene changes on purpose, and only then.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fide_tasks

SIZE, SPP = 32, 16
FRAMES, BATCH = 4096, 64
FIRST_SEED = 10**9  # of noise that no test uses


def measure(name: str) -> dict[str, NDArray[Any]]:
    """Mean and variance of frames, summed in float64 from batches of them."""
    task = fide_tasks.make(name, size=SIZE, spp=SPP)
    x = task.x_star
    if x is None:
        raise SystemExit(f"{name} has no x_star")
    total, squares = np.zeros(task.shape), np.zeros(task.shape)
    for first in range(FIRST_SEED, FIRST_SEED + FRAMES, BATCH):
        frames = task.render(np.tile(x, (BATCH, 1)), seed=range(first, first + BATCH))
        total += frames.sum(axis=0, dtype=np.float64)
        squares += np.square(frames, dtype=np.float64).sum(axis=0)
    mean = total / FRAMES
    variance = np.maximum(squares - FRAMES * mean**2, 0.0) / (FRAMES - 1)
    facts = {"frames": np.array(FRAMES), "size": np.array(SIZE), "spp": np.array(SPP)}
    return {"x": x, "mean": mean.astype("f4"), "variance": variance.astype("f4"), **facts}


def main() -> None:
    parser = argparse.ArgumentParser(description="measure the noise of a task")
    parser.add_argument("task")
    name = parser.parse_args().task
    path = Path(__file__).parent / f"{name}_noise.npz"
    np.savez_compressed(path, allow_pickle=False, **measure(name))


if __name__ == "__main__":
    main()
