"""Smooth scenes of 10 to 27 parameters, for `benchmarks/forward.py`; numpy only.

blobs     14 p.: two soft blobs (place, size, color) on a gradient of two gray levels
lamps     18 p.: three lamps (place, height, color) over a bumpy floor
waves     11 p.: a plane wave and a color gradient, both added up
sheets    27 p.: three soft ellipses painted over each other (place, axes, angle, color, opacity)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Draw: TypeAlias = Callable[[Floats, Floats, Floats], Floats]

__all__ = ["SCENES", "SmoothScene"]


class SmoothScene:
    """A scene with a random answer, as tasks are: `dim`, `target`, `x_star`, `render`."""

    def __init__(self, name: str, seed: int, size: int = 64) -> None:
        self.dim, self._draw = SCENES[name]
        self._axes = np.meshgrid(*[(np.arange(size) + 0.5) / size] * 2)
        self.x_star = np.random.default_rng([seed, self.dim]).uniform(0.1, 0.9, self.dim)
        self.target = self.render(self.x_star[None])[0]

    def render(self, X: Floats) -> NDArray[np.float32]:
        """Images (n, size, size, 3) of parameters (n, dim)."""
        images = [self._draw(x, *self._axes) for x in np.atleast_2d(X)]
        return np.clip(np.array(images), 0.0, 1.0).astype(np.float32)


def _blobs(p: Floats, u: Floats, v: Floats) -> Floats:
    image = (0.2 + 0.3 * p[12] * u + 0.3 * p[13] * v)[..., None] * np.ones(3)
    for x, y, size, *color in p[:12].reshape(2, 6):
        squared = (u - x) ** 2 + (v - y) ** 2
        weight = np.exp(-squared / (2 * (0.06 + 0.2 * size) ** 2))[..., None]
        image = image * (1 - weight) + weight * np.array(color)
    return np.asarray(image, np.float64)


def _lamps(p: Floats, u: Floats, v: Floats) -> Floats:
    slope_u = 0.5 * np.cos(9 * u) * np.sin(7 * v)
    slope_v = 0.5 * np.sin(9 * u) * np.cos(7 * v)
    image = np.full((*u.shape, 3), 0.05)
    for x, y, height, *color in p.reshape(3, 6):
        to_lamp = np.stack([x - u, y - v, np.full_like(u, 0.15 + 0.5 * height)])
        cosine = to_lamp[2] - slope_u * to_lamp[0] - slope_v * to_lamp[1]
        light = np.logaddexp(0, 8 * cosine) / 8 / np.square(to_lamp).sum(axis=0)
        image = image + 0.12 * light[..., None] * np.array(color)
    return np.asarray(1 - np.exp(-image), np.float64)


def _waves(p: Floats, u: Floats, v: Floats) -> Floats:
    phase = 2 * np.pi * (p[0] * u + p[1] * v + 0.5 * p[2])
    gradient = np.stack([p[5 + c] * u + (1 - p[5 + c]) * p[8 + c] * v for c in range(3)], axis=-1)
    colors = np.array([0.5, 0.4, 0.3])
    waves = (p[3] + p[4] * np.sin(phase))[..., None] * colors
    return np.asarray(0.5 * gradient + 0.5 * waves, np.float64)


def _sheets(p: Floats, u: Floats, v: Floats) -> Floats:
    image = np.full((*u.shape, 3), 0.5)
    for x, y, a, b, angle, *color, opacity in p.reshape(3, 9):
        c, s = np.cos(np.pi * angle), np.sin(np.pi * angle)
        along, across = c * (u - x) + s * (v - y), c * (v - y) - s * (u - x)
        radius = np.hypot(along / (0.1 + 0.4 * a), across / (0.1 + 0.4 * b))
        weight = (0.5 + 0.5 * opacity) / (1 + np.exp(np.minimum(12 * (radius - 1), 50)))
        image = image * (1 - weight[..., None]) + weight[..., None] * np.array(color)
    return image


SCENES: dict[str, tuple[int, Draw]] = {
    "blobs": (14, _blobs),
    "lamps": (18, _lamps),
    "waves": (11, _waves),
    "sheets": (27, _sheets),
}
"""Number of parameters, and what draws an image (size, size, 3) of them (dim,)."""
