"""Finds a Mitsuba camera with and without a denoiser, in the same processor time.

    pip install mitsuba mitsuba-oidn        # Open Image Denoise, on the CPU
    python benchmarks/denoiser.py --table   # without --table: measure what is missing

The scene of `examples/mitsuba_camera.py`, with random cameras; the photo has 1,024 samples a pixel.
Each fit has 20 s of processor time.  The error is that of the silhouette, which has no noise:
the mean square of the difference between the found camera and the true one.
"""

from __future__ import annotations

import os
import sys
import time
from functools import cache
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, by_key, command

from fide_plugins import fit

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "denoiser.jsonl"
ARMS, TARGETS, SECONDS = ("plain 16", "denoised 16"), range(10), 20
SOLVED = 1e-3  # two random cameras differ by 0.1 to 0.4


@cache
def photographer() -> Any:
    """The scene with its cameras."""
    sys.path.append(str(ROOT / "examples"))
    return import_module("mitsuba_camera").Photographer()


def photo(p: Any, samples: int, denoised: bool, seed: int) -> Any:
    """Image (64, 64, 3) as a program would return it."""
    camera = photographer()
    camera.aim(camera.params, p)
    image = camera.mi.render(camera.scene, spp=samples, seed=seed)
    if denoised:
        image = import_module("mitsuba_oidn").denoise(np.array(image, np.float32), hdr=True)
    return np.array(camera.mi.util.convert_to_bitmap(image))


def key(row: Row) -> tuple[str, int]:
    """What makes a run."""
    return row["arm"], row["target"]


def measure(run: Row) -> Row:
    """Fit a photo for so many seconds of processor time."""
    arm, number = key(run)
    kind, samples = arm.split()
    camera, noise = photographer(), np.random.default_rng((number, 1))
    space = import_module("mitsuba_camera").SPACE
    truth = space.decode(np.random.default_rng(number).random(space.dim))
    target = photo(truth, 1024, False, 0)

    def render(p: Any) -> Any:
        return photo(p, int(samples), kind == "denoised", int(noise.integers(2**31)))

    render(truth)  # compiles
    start = time.process_time()
    late = lambda _: time.process_time() - start > SECONDS  # noqa: E731
    how: dict[str, Any] = {"workers": 0, "seed": number, "until": "budget", "callbacks": late}
    result = fit(render, target, space, 100_000, **how)
    there, here = (camera.silhouette(p).astype(float) for p in (truth, result.params))
    x, y = space.encode(truth), space.encode(result.params)
    off = np.abs(x - y)
    off[0] = min(off[0], 1 - off[0])  # the azimuth is periodic
    error = float(np.mean((there - here) ** 2))
    return {**run, "error": error, "off": off.tolist(), "renders": result.evaluations}


def table(rows: list[Row]) -> str:
    """Cameras found, and errors."""
    found = by_key(rows, key)
    lines = ["| samples a pixel | found | median error | median renders |", "|---" * 4 + "|"]
    for arm in ARMS:
        each = [found[arm, number] for number in TARGETS if (arm, number) in found]
        error, renders = (np.median([row[name] for row in each]) for name in ("error", "renders"))
        solved = sum(row["error"] < SOLVED for row in each)
        lines.append(f"| {arm} | {solved} of {len(each)} | {error:.2g} | {renders:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    runs = ({"arm": arm, "target": number} for number, arm in product(TARGETS, ARMS))
    command(__doc__ or "", runs, measure, RESULTS, key, table)
