"""A stream: a chessboard that moves over a photograph, and is hidden for a while.

    python benchmarks/photographs.py learn boards.fide
    python benchmarks/stream.py --model boards.fide --out benchmarks/results/stream.jsonl
    python benchmarks/stream.py --table benchmarks/results/stream.jsonl

Ten streams of 40 frames of 160 x 120 pixels: the board of `photographs.py` over a part of a
painted wall that moves, with a gain that drifts, blur, noise and JPEG.  In frames 18 to 25 a strip
of another photograph covers its left part.  `photo=True` with the model, 500 renders for the first
frame, 140 after each `retarget`.  The error is the mean distance of 54 corners, in pixels of
640 x 480.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from moves import span
from numpy.typing import NDArray
from photographs import RANGES, SPACE, draw
from rows import Row, read, run_missing

from fide_lab.suite import foreign, renderers
from fide_plugins import FIDE

FRAMES, FIRST, EACH = 40, 500, 140
HIDDEN = range(18, 26)
MOVING = "rx", "ry", "rz", "cx", "cy", "dist"
PARTS = {"before": range(18), "hidden": HIDDEN, "after": range(26, FRAMES)}


def poses(rng: np.random.Generator) -> list[dict[str, float]]:
    """Parameters of all frames: each swings by 12 % of its range in 30 to 60 frames."""
    low, high = np.array(list(RANGES.values())).T
    middle = rng.uniform(low + 0.35 * (high - low), high - 0.35 * (high - low))
    middle[list(RANGES).index("dist")] = rng.uniform(10, 16)
    swing = 0.12 * (high - low) * [name in MOVING for name in RANGES]
    phase, period = rng.uniform(0, 2 * np.pi, len(RANGES)), rng.uniform(30, 60, len(RANGES))
    angles = 2 * np.pi * np.arange(FRAMES)[:, None] / period + phase
    return [dict(zip(RANGES, row.tolist(), strict=True)) for row in middle + swing * np.sin(angles)]


def stream(number: int) -> tuple[list[dict[str, float]], list[NDArray[np.uint8]]]:
    """Parameters and frames (120, 160)."""
    rng = np.random.default_rng((11, number))
    names = ("graf1", "graf3") if number % 2 == 0 else ("graf3", "graf1")
    wall, other = (cv2.cvtColor(foreign._photograph(name), cv2.COLOR_RGB2GRAY) for name in names)
    wall = cv2.resize(np.asarray(wall, np.float32) / 255, (240, 192))
    other = cv2.resize(np.asarray(other, np.float32) / 255, (200, 160))
    truth, frames = poses(rng), []
    for t, p in enumerate(truth):
        image, cover = draw(p)
        frame = cover * image + (1 - cover) * wall[10 + t // 2 :, 20 + t :][:120, :160]
        if t in HIDDEN:
            strip = frame[:, int(p["cx"] / 4) : int(p["cx"] / 4) + 28]
            strip[:] = other[20:140, 60 : 60 + strip.shape[1]]
        lit = np.clip((0.85 + 0.1 * np.sin(t / 9)) * frame + 0.03, 0, 1).astype(np.float32)
        noisy = cv2.GaussianBlur(lit, (0, 0), 0.6) + rng.normal(0, 0.015, frame.shape)
        pixels = np.clip(255 * noisy, 0, 255).astype(np.uint8)
        packed = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
        frames.append(np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8))
    return truth, frames


def run(planned: Row, model: str) -> Row:
    """Errors of all frames of a stream."""
    errors, search = [], None
    for truth, frame in zip(*stream(planned["stream"]), strict=True):
        most = EACH
        if search is None:
            search, most = FIDE(SPACE, frame, learned=model, photo=True, seed=0), FIRST
        else:
            search.retarget(frame)
        end = search.evaluations + most
        while search.evaluations < end:
            x = search.ask_ready()
            search.tell(x, [draw(SPACE.decode(one)) for one in x])
        best: Any = search.best
        there, seen = (renderers.board_corners(p) for p in (truth, best.params))
        apart = (np.linalg.norm(there - one, axis=1).mean() for one in (seen, seen[::-1]))
        errors.append(round(float(min(apart)), 2))
    return {**planned, "errors": errors}


def table(rows: list[Row]) -> str:
    """Frames within 2 and 4 pixels."""
    lines = []
    for part, which in PARTS.items():
        errors = np.array([[row["errors"][t] for t in which] for row in rows])
        found = [f"{int((errors <= off).sum())} within {off}" for off in (2, 4)]
        lines.append(f"{part}: of {errors.size} frames {', '.join(found)} pixels")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--streams", type=span, default=range(10), metavar="A-B")
    parser.add_argument("--model", default="boards.fide")
    parser.add_argument("--out", type=Path, default=Path("runs/stream.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    planned = ({"stream": number} for number in arguments.streams)
    run_missing(
        planned, partial(run, model=arguments.model), arguments.out, lambda row: row["stream"]
    )


if __name__ == "__main__":
    main()
