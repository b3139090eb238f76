"""A picture on a wall, found in ten views of a photograph that was taken from elsewhere.

    python benchmarks/poster.py learn poster.fide      # 40,000 renders, of the picture alone
    python benchmarks/poster.py find --model poster.fide --out benchmarks/results/poster.jsonl
    python benchmarks/poster.py table --out benchmarks/results/poster.jsonl

The object is a rectangle of the first photograph of a painted wall (`wall` in `photographs.py`);
each view is turned, enlarged and cut out of the second one, and a published homography says where
the corners of the rectangle are.  The error is their mean distance, in pixels of 96 x 80.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from rows import Row, append, read, rows_of

from fide_lab.suite import foreign
from fide_plugins import Float, Space, fit, learn

WIDTH, HEIGHT = 96, 80
LEFT, TOP, RIGHT, BOTTOM = 62, 40, 112, 82  # of 160 x 128
VIEWS, RENDERS, BUDGET = 10, 40_000, 500
MARKS = 150, 300, 500
SPACE = Space(
    x=Float(-0.35, 0.35),  # of the middle, in widths from that of the view
    y=Float(-0.35, 0.35),
    size=Float(0.14, 0.4),  # half of the width
    turn=Float(-0.8, 0.8),
    stretch=Float(-0.4, 0.4),
    shear=Float(-0.5, 0.5),
    across=Float(-0.25, 0.25),  # how much farther its right side is
    down=Float(-0.25, 0.25),
)
_FIRST, _SECOND = (
    np.asarray(foreign._photograph(name) / np.float32(255), np.float32)
    for name in ("graf1", "graf3")
)
_PICTURE = _FIRST[TOP:BOTTOM, LEFT:RIGHT]
_TALL = (BOTTOM - TOP) / (RIGHT - LEFT)
_BOX = np.array([[-1, -_TALL], [1, -_TALL], [1, _TALL], [-1, _TALL]], np.float64)


def corners(p: Mapping[str, float]) -> NDArray[np.float64]:
    """Of the picture, (4, 2) in pixels."""
    c, s = np.cos(p["turn"]), np.sin(p["turn"])
    bend = np.array([[np.exp(p["stretch"]), p["shear"]], [0, np.exp(-p["stretch"])]])
    away = 1 + _BOX @ [p["across"], p["down"]]
    flat = p["size"] * _BOX @ (np.array([[c, -s], [s, c]]) @ bend).T / away[:, None]
    middle = np.array([WIDTH * p["x"] + WIDTH / 2, WIDTH * p["y"] + HEIGHT / 2])
    return np.asarray(middle + WIDTH * flat)


def draw(p: Mapping[str, float]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The picture, and what it covers."""
    height, width = _PICTURE.shape[:2]
    at = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    M, size = cv2.getPerspectiveTransform(at, corners(p).astype(np.float32)), (WIDTH, HEIGHT)
    cover = cv2.warpPerspective(np.ones((height, width), np.float32), M, size)
    image = cv2.warpPerspective(_PICTURE, M, size, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(image, 0, 1), np.clip(cover, 0, 1)


def view(number: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Photograph (80, 96, 3), and where the corners of the picture are in it, (4, 2)."""
    rng = np.random.default_rng((7, number))
    scale = np.diag([160 / 800, 128 / 640, 1])
    H = scale @ foreign._HOMOGRAPHY @ np.linalg.inv(scale)
    box = np.array([[LEFT, TOP], [RIGHT, TOP], [RIGHT, BOTTOM], [LEFT, BOTTOM]], np.float64)
    there = cv2.perspectiveTransform(box[None], H)[0]
    edge = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float64)
    while True:  # all of the view is in the photograph, and all of the picture is in the view
        turn, zoom = rng.uniform(-25, 25), rng.uniform(0.85, 1.25)
        middle = there.mean(axis=0) + rng.uniform(-0.2, 0.2, 2) * [160, 128]
        M = cv2.getRotationMatrix2D(tuple(middle), turn, zoom)
        M[:, 2] += np.array([WIDTH, HEIGHT]) / 2 - middle
        seen = there @ M[:, :2].T + M[:, 2]
        back = cv2.invertAffineTransform(M)
        cut = edge @ back[:, :2].T + back[:, 2]
        inside = (cut >= 0).all() and (cut <= [160, 128]).all()
        if inside and (seen >= 1).all() and (seen <= [WIDTH - 1, HEIGHT - 1]).all():
            return np.clip(cv2.warpAffine(_SECOND, M, (WIDTH, HEIGHT)), 0, 1), seen


def find(number: int, model: str) -> Row:
    """Errors after some numbers of renders."""
    photograph, there = view(number)
    errors: dict[str, float] = {}

    def wrong(params: Any) -> float:
        return round(float(np.linalg.norm(corners(params) - there, axis=1).mean()), 2)

    def note(event: Any) -> None:
        if event.evaluation + 1 in MARKS:
            errors[str(event.evaluation + 1)] = wrong(event.optimizer.best.params)

    result: Any = fit(
        draw, photograph, SPACE, budget=BUDGET, workers=0, seed=0, learned=model, photo=True,
        callbacks=[note], until="budget",
    )  # fmt: skip
    return {"number": number, "errors": errors, "status": result.status.code}


def main() -> None:
    """Learn, find what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["learn", "find", "table"])
    parser.add_argument("file", nargs="?", default="poster.fide")
    parser.add_argument("--model", default="poster.fide")
    parser.add_argument("--out", type=Path, default=Path("runs/poster.jsonl"))
    arguments = parser.parse_args()
    if arguments.what == "learn":
        model = learn(
            draw, SPACE, renders=RENDERS, size=WIDTH, out=arguments.file, backgrounds="generated",
            seed=0,
        )  # fmt: skip
        print(model.report)
    elif arguments.what == "find":
        there = {row["number"] for row in rows_of(arguments.out)}
        for number in sorted(set(range(VIEWS)) - there):
            row = find(number, arguments.model)
            append(arguments.out, row)
            print(row, flush=True)
    else:
        rows = read(arguments.out)
        for mark in MARKS:
            off = [row["errors"][str(mark)] for row in rows]
            print(f"within 2 pixels after {mark}: {sum(one <= 2 for one in off)} of {len(off)}")


if __name__ == "__main__":
    main()
