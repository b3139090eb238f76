"""Tasks whose targets are drawn until every parameter shows.

A scene is drawn in sides: lengths relative to the shorter side of the image, x to the right and y
down from its center. So the same parameters show the same picture at every resolution.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Task, Vector

_JUDGING_SIDE = 64  # generated targets are judged on images of about this many pixels a side
_STEP = 0.02  # of the range of a parameter
_DRAWS = 200  # of a target at most; then the best of them


class GeneratedTask(Task):
    """A task without noise that draws its own targets.

    A target is accepted if each parameter shows: a step of 0.02 of its range, up or down, changes
    the image by `least_change` on average, measured at about 64 x 64 pixels (mean absolute
    difference over all pixels and channels). Otherwise the groups of the parameters that do not
    show are drawn again; all parameters, where a parameter belongs to no group. Of 200 draws that
    all fail, the task takes the one whose least visible parameter shows most.

    `_render` must take the size of the image from `out`, not from the task.
    """

    least_change: ClassVar[float] = 2e-4

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        target: ArrayLike | None = None,
    ) -> None:
        super().__init__(size, seed, picture=target)

    @abstractmethod
    def _draw(self, rng: np.random.Generator) -> Vector:
        """Draw the parameters of a target, (dim,) in [0, 1]."""

    def _make_x_star(self) -> Vector:
        rng = np.random.default_rng((self.seed, self.dim))
        x = best = self._draw(rng)
        most = -1.0
        for _ in range(_DRAWS):
            shown = self._changes(x)
            if shown.min() > most:
                best, most = x, float(shown.min())
            hidden = shown < self._required_change()
            if not hidden.any():
                break
            x = self._drawn_again(x, hidden, rng)
        return best

    def _required_change(self) -> float:
        """Mean change of the image by a step of a parameter from which on it counts as visible."""
        return self.least_change

    def _changes(self, x: Vector) -> Vector:
        """Mean absolute change of the image by a step up or down of each parameter, (dim,)."""
        step = np.where(x < 0.5, _STEP, -_STEP)
        candidates = np.vstack([x, x + np.diag(step)])
        images: Image = np.empty((len(candidates), *self._judging_size(), 3), np.float32)
        self._render(self._physical(candidates), images, np.zeros(len(candidates), np.uint32))
        change: Vector = np.abs(images[1:] - images[0]).mean(axis=(1, 2, 3), dtype=np.float64)
        return change

    def _judging_size(self) -> tuple[int, int]:
        height, width = self.size
        scale = _JUDGING_SIDE / math.sqrt(height * width)
        return max(1, round(height * scale)), max(1, round(width * scale))

    def _drawn_again(
        self, x: Vector, hidden: NDArray[np.bool_], rng: np.random.Generator
    ) -> Vector:
        fresh = self._draw(rng)
        again = [group for group in self.groups or [] if hidden[group].any()]
        if hidden.sum() > sum(hidden[group].sum() for group in again):
            return fresh
        x = x.copy()
        for group in again:
            x[group] = fresh[group]
        return x


@cache
def axes(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where the pixel centers are, in sides: x (1, W) and y (H, 1). Do not change them."""
    side = min(height, width)
    x, y = ((np.arange(n) + 0.5 - n / 2) / side for n in (width, height))
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


def half_extent(size: tuple[int, int]) -> tuple[float, float]:
    """Return how far the image reaches from its center, in sides: across and down."""
    height, width = size
    return width / (2 * min(size)), height / (2 * min(size))
