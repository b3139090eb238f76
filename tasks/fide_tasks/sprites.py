"""Sprites: flowers with three, four or five petals that cover each other by their depths.

Each sprite has a depth, and the nearer one covers the farther one, whatever their order: so n
sprites can be exchanged and have n! optima although they cover each other. Depth shows also where
nothing overlaps: the farther a sprite, the softer its edge (the camera is focused on the near).

Notation: polar coordinates (r, phi) around a sprite's center, turned by its angle; its outline is
R(phi) = size (1 + sum over k of a_k cos(k phi)), k = 3, 4, 5, where the shape s in [0, 1] blends
a_3 (s = 0) over a_4 (s = 1/2) into a_5 (s = 1). A pixel is covered by the smooth step of
(R - r) / softness + 1/2, all in sides.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Vector, whole_number
from fide_tasks.generated import GeneratedTask, axes, half_extent

_KINDS = 9  # parameters of a sprite
_PETALS = 0.28  # amplitude of the outline, relative to the size
_SOFTNESS = (0.02, 0.2)  # width of the edge in sides, of the nearest and of the farthest
_SKY = np.array([0.80, 0.86, 0.90], np.float32)
_GROUND = np.array([0.93, 0.88, 0.78], np.float32)

Plane = NDArray[np.float32]


class Sprites(GeneratedTask):
    """Soft sprites at depths before a plain background.

    Options
    -------
    sprites: number n of sprites, at least 1; by default 5.
    target: a picture of the user's own, float (H, W, 3) in [0, 1], instead of a generated one.

    The 9 n parameters are x, y, size in sides, angle, depth (0 is near), shape, red, green and blue
    of each sprite. Two sprites of the same depth are ordered by their other parameters.

    `seed` chooses the target: sprites with a color different from the background, none hidden.
    """

    name = "sprites"
    least_change = 1e-4

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        sprites: int = 5,
        target: ArrayLike | None = None,
    ) -> None:
        self.sprites = whole_number("sprites", sprites, minimum=1)
        super().__init__(size, seed, target=target)
        across, down = half_extent(self.size)
        scale = math.sqrt(5 / max(self.sprites, 5))
        kinds = (
            ("x", "sides", -across, across),
            ("y", "sides", -down, down),
            ("size", "sides", 0.08 * scale, 0.24 * scale),
            ("angle", "degrees", -35.0, 35.0),  # five petals repeat every 72 degrees
            ("depth", "0-1", 0.0, 1.0),
            ("shape", "0-1", 0.0, 1.0),
            *((color, "0-1", 0.0, 1.0) for color in ("red", "green", "blue")),
        )
        self.parameters = tuple(
            Parameter(f"sprite {i + 1}", *kind) for i in range(self.sprites) for kind in kinds
        )

    @property
    def groups(self) -> list[list[int]]:
        """The parameters of each sprite."""
        return np.arange(self.dim).reshape(-1, _KINDS).tolist()

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        _, y = axes(out.shape[1], out.shape[2])
        height = np.clip(y[:, :, None] + np.float32(0.5), 0, 1)
        out[:] = _SKY + height * (_GROUND - _SKY)
        for v, frame in zip(values.reshape(len(values), self.sprites, _KINDS), out, strict=True):
            for sprite in v[_far_to_near(v)]:
                _paint(frame, sprite)

    def _required_change(self) -> float:
        return self.least_change * 5 / max(self.sprites, 5)

    def _draw(self, rng: np.random.Generator) -> Vector:
        x = rng.random((self.sprites, _KINDS))
        x[:, :2] = 0.12 + 0.76 * x[:, :2]
        x[:, 2:6] = 0.1 + 0.8 * x[:, 2:6]
        for sprite in x:
            while np.linalg.norm(sprite[6:] - (_SKY + _GROUND) / 2) < 0.5:
                sprite[6:] = rng.random(3)
        return x.ravel()


def _far_to_near(v: Vector) -> NDArray[np.intp]:
    """Return the order of painting of the sprites (n, 9): by depth, then by all the rest."""
    depth = 4
    return np.lexsort([*np.delete(v, depth, axis=1).T, -v[:, depth]])


def _paint(frame: Image, sprite: Vector) -> None:
    x, y, size, angle, depth, shape = sprite[:6].tolist()
    soft = _SOFTNESS[0] + depth * (_SOFTNESS[1] - _SOFTNESS[0])
    height, width = frame.shape[:2]
    side = min(height, width)
    reach = size * (1 + _PETALS) + soft / 2
    rows = _span(y, reach, height, side)
    columns = _span(x, reach, width, side)
    across, down = axes(height, width)
    dx, dy = across[:, columns] - np.float32(x), down[rows] - np.float32(y)
    r = np.sqrt(dx * dx + dy * dy)
    covered = (_outline(dx, dy, r, size, angle, shape) - r) * np.float32(1 / soft) + np.float32(0.5)
    covered = np.clip(covered, 0, 1)
    covered = (covered * covered * (3 - 2 * covered))[:, :, None]  # a smooth step
    window = frame[rows, columns]
    window += covered * (sprite[6:].astype(np.float32) - window)


def _span(center: float, reach: float, n: int, side: int) -> slice:
    """Return the pixels within `reach` of `center`, along an axis of n pixels."""
    middle, pixels = center * side + n / 2, reach * side
    first = min(max(0, math.floor(middle - pixels)), n)
    return slice(first, max(first, min(n, math.ceil(middle + pixels))))


def _outline(dx: Plane, dy: Plane, r: Plane, size: float, angle: float, shape: float) -> Plane:
    """Return R(phi) at each pixel; cos(k phi) by Chebyshev polynomials of c = cos(phi)."""
    turn = math.radians(angle)
    c = dx * np.float32(math.cos(turn)) + dy * np.float32(math.sin(turn))
    c /= np.maximum(r, np.float32(1e-6))
    three, five = max(0.0, 1 - 2 * shape), max(0.0, 2 * shape - 1)
    four = 1 - three - five
    c2 = c * c
    wave = np.float32(three) * c * (4 * c2 - 3)
    wave += np.float32(four) * (8 * c2 * (c2 - 1) + 1)
    wave += np.float32(five) * c * ((16 * c2 - 20) * c2 + 5)
    return np.asarray(np.float32(size) * (1 + np.float32(_PETALS) * wave))
