"""Learn a renderer of similar things once: pictures are then found before anything is rendered.

Three spots of light on a wall. Which of them is the first does not matter, so `learn` trains a
learned renderer (an emulator), too. Descents through it find the lights of a new picture.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins import FIDE, Float, Group, Space, learn

SIDE = 16
GRID = (np.arange(SIDE) + 0.5) / SIDE
COLD, WARM = np.array([0.3, 0.5, 1.0]), np.array([1.0, 0.6, 0.2])
SPACE = Space(lights=3 * Group(x=Float(0, 1), y=Float(0, 1), warmth=Float(0, 1)))


def render(params: dict[str, Any]) -> NDArray[np.float64]:
    """Image (SIDE, SIDE, 3) of the wall."""
    wall = np.zeros((SIDE, SIDE, 3))
    for light in params["lights"]:
        squares = (GRID[None] - light["x"]) ** 2 + (GRID[:, None] - light["y"]) ** 2
        color = COLD + light["warmth"] * (WARM - COLD)
        wall += np.exp(-squares / 0.03)[..., None] * color
    return 1 - np.exp(-wall)  # as a camera sees it, which cannot be brighter than 1


def renders_until_solved(target: NDArray[np.float64], seed: int, learned: Any) -> int:
    """Renders until the MSE is at most 1e-4; at most 600."""
    opt = FIDE(SPACE, target, seed=seed, learned=learned)
    while opt.evaluations < 600 and (opt.best is None or opt.best.loss > 1e-4):
        X = opt.ask()
        opt.tell(X, [render(params) for params in SPACE.decode_many(X)])
    return opt.evaluations


def main() -> None:
    model = learn(render, SPACE, renders=6000, size=SIDE, passes=5, augment="none")
    print(model.report)
    rng = np.random.default_rng(1)
    pictures = [render(params) for params in SPACE.decode_many(rng.random((3, SPACE.dim)))]
    for what, learned in (("without a model", None), ("with the model", model)):
        renders = [renders_until_solved(target, i, learned) for i, target in enumerate(pictures)]
        print(f"renders until solved, {what}: {renders}")


if __name__ == "__main__":
    main()
