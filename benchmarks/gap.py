"""Pictures that the renderer did not quite draw: poses found with `photo=True`, and without.

    python benchmarks/gap.py --targets 720-729 --out runs/gap.jsonl
    python benchmarks/gap.py --table benchmarks/results/gap.jsonl

The clean target of robot and arm gets another exposure, a shading, an occluder, or the blur, noise
and JPEG of a camera.  A pose is found if the clean render of the answer differs from the clean
target by less than a hundredth of what random renders do: not the loss that was minimized judges.
"""

from __future__ import annotations

import argparse
import io
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from moves import span
from numpy.typing import NDArray
from PIL import Image
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins import FIDE

SCENES = "robot", "arm"
GAPS = "clean", "exposure", "shading", "occluder", "camera"
BUDGET, SIZE = 1500, 64
FOUND = 0.01
ARMS: dict[str, dict[str, Any]] = {"photo": {"photo": True}, "default": {}}


def changed(image: NDArray[Any], gap: str, rng: np.random.Generator) -> NDArray[np.float32]:
    """The picture (H, W, 3) that somebody else would take of the same scene."""
    y = image.astype(np.float64)
    height, width = y.shape[:2]
    if gap == "exposure":
        y = 0.9 * (0.85 * y) ** 1.35 + 0.04
    elif gap == "shading":
        field = cv2.resize(rng.uniform(0.65, 1.3, (3, 3)), (width, height), interpolation=2)
        y = y * np.asarray(field)[..., None]
    elif gap == "occluder":
        tall, wide = int(0.3 * height), int(0.25 * width)
        top, left = rng.integers(0, height - tall), rng.integers(0, width - wide)
        patch = cv2.resize(rng.uniform(0, 1, (6, 6, 3)), (wide, tall))
        y[top : top + tall, left : left + wide] = patch
    elif gap == "camera":
        y = np.asarray(cv2.GaussianBlur(y, (0, 0), 1.44 * height / 112))
        y = np.clip(y + rng.normal(0, 0.03, y.shape), 0, 1)
        file = io.BytesIO()
        Image.fromarray((y * 255).round().astype(np.uint8)).save(file, "JPEG", quality=50)
        y = np.asarray(Image.open(file)) / 255
    return np.clip(y, 0, 1).astype(np.float32)


def error(task: Any, x: NDArray[np.float64]) -> float:
    """Mean squared error of the clean render at x, over the median of random renders."""
    random = np.random.default_rng(5).uniform(0, 1, (60, task.dim))
    errors = ((task.render(np.vstack([x, random])) - task.target) ** 2).mean((1, 2, 3))
    return float(errors[0] / np.median(errors[1:]))


def planned_runs(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, targets outermost."""
    for target in arguments.targets:
        for scene in SCENES:
            for gap in GAPS:
                for arm in arguments.arms:
                    yield {"scene": scene, "gap": gap, "target": target, "arm": arm}


def run(planned: Row) -> Row:
    """One run: its error, and what is said of it."""
    seed = planned["target"]
    task: Any = fide_tasks.make(planned["scene"], size=SIZE, seed=seed)
    picture = changed(task.target, planned["gap"], np.random.default_rng(7 * seed + 1))
    search = FIDE(task.dim, picture, seed=seed, **ARMS[planned["arm"]])
    while search.evaluations < BUDGET:
        x = search.ask_ready()
        search.tell(x, task.render(x))
    best = search.best
    assert best is not None
    return {**planned, "error": error(task, best.x), "status": search.status.code}


def table(rows: list[Row]) -> str:
    """Found of how many, by scene and gap."""
    lines = ["| scene | gap | " + " | ".join(ARMS) + " |", "|---|---|" + "---|" * len(ARMS)]
    found: Counter[tuple[str, ...]] = Counter()
    total: Counter[tuple[str, ...]] = Counter()
    for row in rows:
        cell = row["scene"], row["gap"], row["arm"]
        total[cell] += 1
        found[cell] += row["error"] < FOUND
    for scene in SCENES:
        for gap in GAPS:
            cells = [(scene, gap, arm) for arm in ARMS]
            shown = [f"{found[cell]} of {total[cell]}" if total[cell] else "-" for cell in cells]
            lines.append(f"| {scene} | {gap} | {' | '.join(shown)} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--targets", type=span, default=range(720, 730), metavar="A-B")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--out", type=Path, default=Path("runs/gap.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(
        planned_runs(arguments),
        run,
        arguments.out,
        lambda row: (row["scene"], row["gap"], row["target"], row["arm"]),
    )


if __name__ == "__main__":
    main()
