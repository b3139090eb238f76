"""Photographs: a chessboard, a painted wall and two coins, none of them drawn by a renderer.

    python examples/photographs.py          # a short run
    python examples/photographs.py 1500     # the run of the gallery

Each is a problem of the suite `image-fitting-foreign-v1`, which knows what is true: corners that
OpenCV detects, a published homography, a segmentation.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fide_lab.suite import foreign
from fide_plugins import FIDE, fit

PROBLEMS: dict[tuple[str, int], dict[str, Any]] = {  # options of each search, beside photo=True
    ("board_near", 8): {},
    ("wall", 0): {},
    ("coin", 0): {},
    ("coin", 11): {},
}
TRUTH = {"f": 534.1, "k1": -0.258, "radius of the first coin": 29.0}
HEIGHT, GAP = 300, 12


def shown(problem: foreign.Problem, points: Any) -> list[NDArray[np.float32]]:
    """The photograph, and renders of points in its light, over it where they cover nothing."""
    space = problem.search_space or problem.dim
    compare = FIDE(space, problem.target, photometric="exposure", background="free")
    images = compare.adjust(problem.render(np.stack(points)))
    return [problem.target, *np.clip(images, 0, 1)]


def row(images: list[NDArray[np.float32]]) -> Image.Image:
    """The pictures beside each other, each `HEIGHT` pixels high."""
    width = round(HEIGHT * images[0].shape[1] / images[0].shape[0])
    strip = Image.new("RGB", (3 * (width + GAP) - GAP, HEIGHT), "white")
    for i, image in enumerate(images):
        picture = Image.fromarray((image * 255).round().astype(np.uint8))
        strip.paste(
            picture.resize((width, HEIGHT), Image.Resampling.LANCZOS), (i * (width + GAP), 0)
        )
    return strip


def page(rows: list[Image.Image]) -> Image.Image:
    """All rows below each other, in the middle, with a line of titles."""
    width, top = max(one.width for one in rows), 30
    whole = Image.new("RGB", (width, top + len(rows) * (HEIGHT + GAP)), "white")
    for i, one in enumerate(rows):
        whole.paste(one, ((width - one.width) // 2, top + i * (HEIGHT + GAP)))
    titles = ImageDraw.Draw(whole)
    for i, title in enumerate(("photograph", "found", "true")):
        titles.text(((i + 0.5) * width / 3, top / 2), title, "black", anchor="mm", font_size=20)
    return whole


def main(budget: int) -> None:
    rows = []
    for (name, number), options in PROBLEMS.items():
        problem = foreign.make(name, number)
        space = problem.search_space or problem.dim
        out = f"runs/photographs-{budget}/{name}-{number}"
        result: Any = fit(
            problem.draw, problem.target, space, photo=True, budget=budget, workers=0, seed=0,
            out=out, resume=True, **options,
        )  # fmt: skip
        print(f"{name}-{number}: error {problem.error(result.best.x):.2f} pixels, {result.status}")
        if name != "wall":
            print({key: round(value, 3) for key, value in result.params.items()})
        rows.append(row(shown(problem, [result.best.x, problem.truth])))
    file = Path(f"runs/photographs-{budget}/photographs.jpg")
    page(rows).save(file, quality=88)
    print(f"look at {file}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
