"""Which parameters `Solution.undetermined` names, where it is known which ones the picture shows.

    python benchmarks/undetermined.py --seeds 100-109

The picture shows x, y, gray, shape and rows; paper, pages and back change nothing.
"""

from __future__ import annotations

import argparse
import os
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from fide_plugins import FIDE, Choice, Float, Int, Space

SPACE = Space(
    x=Float(-0.7, 0.7), y=Float(-0.7, 0.7), gray=Float(0.1, 1),
    shape=Choice("disk", "square", "ring"), paper=Choice("a4", "a5", "a6"), rows=Int(1, 4),
    pages=Int(1, 4), back=Choice("left", "right"),
)  # fmt: skip
BLIND = {"paper", "pages", "back"}
BUDGET = 800
V, U = np.mgrid[-1:1:16j, -1:1:16j]


def render(p: dict[str, Any], noise: float, rng: np.random.Generator) -> Any:
    far = U - p["x"], V - p["y"]
    round_, square = np.hypot(*far), np.abs(far).max(axis=0)
    reach = {"disk": round_, "square": square, "ring": abs(round_ - 0.25) + 0.3}[p["shape"]]
    inside = 1 / (1 + np.exp(20 * (reach - 0.5)))
    image = inside * p["gray"] + (1 - inside) * (0.25 + 0.2 * np.cos(np.pi * p["rows"] * V))
    if noise:
        image = np.clip(image + noise * rng.normal(size=V.shape), 0, 1)
    return np.repeat(image[..., None], 3, axis=2)


def named(seed: int, noise: float) -> set[str]:
    rng = np.random.default_rng(seed)
    truth = SPACE.decode(rng.random(SPACE.dim))
    opt = FIDE(SPACE, render(truth, noise, rng), seed=seed)
    while opt.evaluations < BUDGET:
        X = opt.ask()
        opt.tell(X, [render(SPACE.decode(x), noise, rng) for x in X])
    assert opt.best is not None
    return set(opt.best.undetermined)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="0-9")
    first, last = map(int, parser.parse_args().seeds.split("-"))
    shown = set(SPACE.parameters) - BLIND
    for noise in (0.0, 0.02):
        found = [named(seed, noise) for seed in range(first, last + 1)]
        rights, wrongs = (sum(len(one & names) for one in found) for names in (BLIND, shown))
        print(
            f"noise {noise}: {rights} of {len(BLIND) * len(found)} that do not show are named, "
            f"{wrongs} of {len(shown) * len(found)} that do"
        )


if __name__ == "__main__":
    main()
