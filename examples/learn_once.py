"""Learn a renderer once, then fit several pictures of it in a few renders each.

An arm of two links with three angles: a search that begins at nothing often folds it the wrong way.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fide_plugins import FIDE, Float, Space, learn

SIDE = 32
COLORS = ((0.9, 0.3, 0.2), (0.2, 0.7, 0.3), (0.2, 0.4, 0.9))
SPACE = Space(
    base=Float(0, 360, unit="deg", periodic=True),
    elbow=Float(-150, 150, unit="deg"),
    wrist=Float(-120, 120, unit="deg"),
)


def render(params: dict[str, Any]) -> NDArray[np.float32]:
    """Image (SIDE, SIDE, 3) of the arm, by areas of a picture four times as large."""
    large = np.ones((4 * SIDE, 4 * SIDE, 3), np.float32)
    place, angle = np.array([0.5, 0.5]), 0.0
    for name, color, length in zip(params, COLORS, (0.2, 0.16, 0.1), strict=True):
        angle += np.deg2rad(params[name])
        end = place + length * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(np.rint(p * 4 * SIDE * 16).astype(int).tolist()) for p in (place, end)]
        cv2.line(large, ends[0], ends[1], color, 3 * SIDE // 8, cv2.LINE_AA, 4)
        place = end
    small = cv2.resize(large, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def renders_until_solved(target: NDArray[np.float32], seed: int, learned: Any) -> int:
    """Renders until the MSE is at most 1e-4; at most 600."""
    opt = FIDE(SPACE, target, seed=seed, learned=learned)
    while opt.evaluations < 600 and (opt.best is None or opt.best.loss > 1e-4):
        X = opt.ask()
        opt.tell(X, [render(params) for params in SPACE.decode_many(X)])
    return opt.evaluations


def main() -> None:
    model = learn(render, SPACE, renders=4000, size=SIDE, passes=6)
    print(model.report)
    rng = np.random.default_rng(1)
    pictures = [render(params) for params in SPACE.decode_many(rng.random((5, SPACE.dim)))]
    for what, learned in (("without a model", None), ("with the model", model)):
        renders = [renders_until_solved(target, i, learned) for i, target in enumerate(pictures)]
        print(f"renders until solved, {what}: {renders}")


if __name__ == "__main__":
    main()
