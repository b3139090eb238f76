"""Compares two views with each view alone, and a masked picture with one that needs no mask.

    python benchmarks/views.py
    python benchmarks/views.py --table

Scene: three colored balls in a box, (x, y, z) each, seen in parallel projection from the front and
from the side, 48 pixels each.  A view does not show its own depth, but for which ball hides which.

"front", "side" and "both" have the same renders (a render of both views counts as one).  Error:
mean absolute difference of the nine parameters from the truth.

"masked" is the front view with a second half beside it, 48 x 96 pixels, in which stripes differ
from render to render; the mask hides that half.  Its loss should be that of "front".

Every fit is a line of benchmarks/results/views.jsonl for each number of renders; a second call does
the missing fits.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, append, missing, read, report

from fide_plugins import FIDE
from fide_plugins.types import Float32, Float64

RESULTS = Path(__file__).parent / "results" / "views.jsonl"
SIZE = 48
TARGETS = 12
RADIUS = 0.16
COLORS = np.array([[0.9, 0.2, 0.1], [0.1, 0.7, 0.3], [0.2, 0.3, 0.95]])
GRID = (np.arange(SIZE) + 0.5) / SIZE


def view(points: Float64, axes: tuple[int, int, int]) -> Float32:
    """Image (SIZE, SIZE, 3) of balls (3, 3); axes: right, down, depth; small depth is in front."""
    image = np.full((SIZE, SIZE, 3), 0.5)
    right, down, depth = axes
    for i in np.argsort(-points[:, depth], kind="stable"):
        p = 0.15 + 0.7 * points[i]
        distance = np.hypot(GRID[None, :] - p[right], GRID[:, None] - p[down])
        inside = np.clip((RADIUS - distance) * SIZE + 0.5, 0, 1)[..., None]
        shade = np.sqrt(np.clip(1 - np.square(distance / RADIUS), 0, 1))[..., None]
        image += inside * (COLORS[i] * (0.3 + 0.7 * shade) - image)
    return image.astype(np.float32)


def front(x: Float64) -> Float32:
    """From the front: x to the right, y down."""
    return view(x[:9].reshape(3, 3), (0, 1, 2))


def side(x: Float64) -> Float32:
    """From the side: z to the right, y down."""
    return view(x[:9].reshape(3, 3), (2, 1, 0))


def cluttered(X: Float64) -> Float32:
    """From the front, and beside it stripes of which no parameter decides."""
    tilts = np.random.default_rng(np.frombuffer(X.tobytes(), np.uint32)).uniform(size=(len(X), 2))
    waves = 12 * np.pi * (GRID[None, :] * tilts[:, :1, None] + GRID[:, None] * tilts[:, 1:, None])
    stripes = np.repeat((0.5 + 0.5 * np.sin(waves))[..., None], 3, axis=-1)  # (n, SIZE, SIZE, 3)
    return np.concatenate([stacked(front)(X), stripes], axis=2).astype(np.float32)


def stacked(render: Callable[[Float64], Float32]) -> Callable[[Float64], Float32]:
    """The same of points (n, d)."""
    return lambda X: np.stack([render(x) for x in X])


SCENES: dict[str, Callable[[Float64], Any]] = {
    "front": stacked(front),
    "side": stacked(side),
    "both": lambda X: [stacked(front)(X), stacked(side)(X)],
    "masked": cluttered,
}
MASK = np.ones((SIZE, 2 * SIZE), np.float32)
MASK[:, SIZE:] = 0


def planned(targets: int, renders: list[int]) -> Iterator[Row]:
    """All rows, without their results: those of a fit one after the other."""
    for seed in range(targets):
        for name in SCENES:
            for number in renders:
                yield {"name": name, "seed": seed, "renders": number}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a row."""
    return row["name"], row["seed"], row["renders"]


def run(name: str, seed: int, renders: list[int]) -> list[Row]:
    """One fit of one target, seen after so many renders."""
    truth = np.random.default_rng(1000 + seed).uniform(0.05, 0.95, 9)
    images_of = SCENES[name]
    target = images_of(truth[None])
    target = [one[0] for one in target] if name == "both" else target[0]
    opt = FIDE(9, target, mask=MASK if name == "masked" else None, seed=seed)
    rows = []
    for number in renders:
        while opt.evaluations < number:
            X = opt.ask()
            opt.tell(X, images_of(X))
        best = opt.best
        assert best is not None
        error = float(np.abs(best.x - truth).mean())
        rows.append(dict(name=name, seed=seed, renders=number, error=error, loss=best.loss))
    return rows


def table(rows: list[Row]) -> str:
    """Median error, fits that found the truth, and median loss of each configuration."""
    columns = ("renders", "target", "median error", "error < 0.01", "median loss")
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for renders in sorted({row["renders"] for row in rows}):
        for name in SCENES:
            own = [row for row in rows if (row["name"], row["renders"]) == (name, renders)]
            errors, losses = (np.array([row[what] for row in own]) for what in ("error", "loss"))
            found = f"{int((errors < 0.01).sum())} of {len(errors)}"
            values = f"{np.median(errors):.4f} | {found} | {np.median(losses):.2g}"
            lines.append(f"| {renders} | {name} | {values} |")
    return "\n".join(lines)


def main() -> None:
    """Do the fits that are missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--renders", type=int, nargs="+", default=[300, 1500])
    parser.add_argument("--targets", type=int, default=TARGETS)
    args = parser.parse_args()
    if args.table:
        print(table(read(args.out)))
        return
    renders = sorted(args.renders)
    for fit in missing(planned(args.targets, renders), args.out, key):
        rows = run(fit["name"], fit["seed"], renders)
        for row in missing(rows, args.out, key):
            append(args.out, row)
            report(row)


if __name__ == "__main__":
    main()
