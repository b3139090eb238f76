"""Fit a renderer of your own: any function that turns numbers in [0, 1] into an image will do.

Three overlapping translucent disks, 18 parameters; writes own_renderer.png (target and result).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import FIDE

SIDE = 64
yy, xx = np.mgrid[0:SIDE, 0:SIDE] / (SIDE - 1)


def render(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image (SIDE, SIDE, 3) of three disks, each x, y, radius, red, green, blue."""
    image = np.ones((SIDE, SIDE, 3))
    for cx, cy, radius, *color in x.reshape(3, 6):
        inside = 1 / (1 + np.exp((np.hypot(xx - cx, yy - cy) - 0.05 - 0.3 * radius) * SIDE))
        image += 0.8 * inside[..., None] * (np.array(color) - image)
    return image


def main() -> None:
    target = render(np.random.default_rng(4).random(18))
    opt = FIDE(18, target, seed=0)
    while opt.evaluations < 1500:
        X = opt.ask()
        opt.tell(X, [render(x) for x in X])
    assert opt.best is not None
    print(f"MSE {opt.best.loss:.2e} after {opt.best.evaluation + 1} renders")
    pair = np.concatenate([target, render(opt.best.x)], axis=1)
    Image.fromarray(np.rint(pair * 255).astype(np.uint8)).save("own_renderer.png")


if __name__ == "__main__":
    main()
