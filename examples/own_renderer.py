"""Fit your own renderer: any function that maps parameters to an image.

Three overlapping translucent disks, 18 parameters; writes own_renderer.png (target and result).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import Float, Group, Space, fit

SIDE = 64
yy, xx = np.mgrid[0:SIDE, 0:SIDE] / (SIDE - 1)

disk = Group(
    x=Float(0, 1), y=Float(0, 1), radius=Float(0.05, 0.35),
    red=Float(0, 1), green=Float(0, 1), blue=Float(0, 1),
)  # fmt: skip
space = Space(disks=3 * disk)


def render(params: dict[str, Any]) -> NDArray[np.float64]:
    """Image (SIDE, SIDE, 3) of three disks, the later ones above."""
    image = np.ones((SIDE, SIDE, 3))
    for p in params["disks"]:
        edge = np.hypot(xx - p["x"], yy - p["y"]) - p["radius"]
        inside = 1 / (1 + np.exp(edge * SIDE))
        color = np.array([p["red"], p["green"], p["blue"]])
        image += 0.8 * inside[..., None] * (color - image)
    return image


def main() -> None:
    target = render(space.decode(np.random.default_rng(4).random(space.dim)))
    result = fit(render, target, space, budget=1500, workers=2, seed=0)
    print(result)
    pair = np.concatenate([target, render(result.params)], axis=1)
    Image.fromarray(np.rint(pair * 255).astype(np.uint8)).save("own_renderer.png")


if __name__ == "__main__":
    main()
