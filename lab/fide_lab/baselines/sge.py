"""Stochastic gradient estimation per pixel (Deliot, Heitz and Belcour 2024, arXiv:2404.09758).

All parameters are moved at once, by random signs: two renders, at x + e s and x - e s, give the
difference of the squared error of each pixel.  A pixel depends on few parameters, so the gradient
of a parameter is averaged over the pixels that it touches, its support, and Adam descends.  Their
rasterizer says by an ID buffer which primitive a pixel shows; here the support of a primitive is
measured: one render in which its parameters are moved, beside one of x.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline, needed_images
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive, positive_fraction
from fide_plugins.validation.points import whole_number

VISIBLE = 1 / 512  # change of a channel from which on a pixel is touched
BETAS, TINY = (0.9, 0.999), 1e-8  # of Adam


@dataclass
class Batch:
    """Points (n, dim) that are learned from together, and those of their images that are told.

    measures: whether they say which pixels a primitive touches.
    """

    points: Float64
    measures: bool
    images: dict[int, Float32] = field(default_factory=dict)


class SGE(Baseline):
    """Gradients of all parameters from two renders, averaged over the pixels that each touches.

    block: parameters of a primitive, which follow each other and have one support (Voronoi: 5,
        triangles: 10).
    popsize: renders of a step, an odd number less one; None: 8, four pairs.
    epsilon: by which parameters are moved, in units of the box.
    learning_rate: of Adam at first, in units of the box; it falls to a tenth along a cosine.
    share: of the renders that measure supports, after the first time.
    budget: evaluations that are planned.
    sigma0: standard deviation of the start around the center, where many scenes are symmetric.

    It learns from squared errors of pixels, whatever the loss, and cannot be resumed.  The other
    options are those of `Baseline`.  Raises OptionError, and ImageError without a target.
    """

    name: ClassVar[str] = "sge"
    resumable = False

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        block: int = 1,
        epsilon: float = 0.015,
        learning_rate: float = 0.03,
        share: float = 0.2,
        budget: int = 10_000,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        if self.target is None:
            raise ImageError(f"{self.name} learns from images and needs a target; got none")
        self.block = whole_number("block", block, 1)
        self.epsilon = positive("epsilon", epsilon)
        self.learning_rate = positive("learning_rate", learning_rate)
        self.share = positive_fraction("share", share)
        self.budget = whole_number("budget", budget, 1)
        self._pairs, self._primitives = self.popsize // 2, -(-self.dim // self.block)
        self._rng = np.random.default_rng(self.seed)
        start = 0.5 + self.sigma0 * self._rng.standard_normal(self.dim)
        self._x = np.clip(start, 0.0, 1.0)
        self._moments = np.zeros((2, self.dim))
        self._steps = self._told = 0  # of Adam; images that were learned from
        self._paid = 0  # images of pairs since the last measurement
        self._support: Float32 | None = None  # (primitives, H W), rows that add up to 1
        self._asked_as: dict[bytes, list[tuple[Batch, int]]] = {}
        self._plan()

    def recommend(self) -> Float64:
        """The point (dim,) from which it descends."""
        return self._x.copy()

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        return {**super().settings(), "popsize": 2 * self._pairs}

    def _plan(self) -> None:
        """Say what is asked next: supports, or pairs."""
        cost = (self._primitives + 1) * (1 - self.share) / self.share
        self.measuring = self._support is None or self._paid >= cost
        self.popsize = self._primitives + 1 if self.measuring else 2 * self._pairs

    def _sample(self) -> Float64:
        if self.measuring:
            away = np.zeros((self.popsize, self.dim))
            for i, signs in enumerate(self._signs(self._primitives)):
                own = slice(i * self.block, (i + 1) * self.block)
                away[i + 1, own] = signs[own]
        else:
            signs = self._signs(self._pairs)
            away = np.stack([signs, -signs], axis=1).reshape(-1, self.dim)
        batch = Batch(np.clip(self._x + self.epsilon * away, 0.0, 1.0), self.measuring)
        for i, x in enumerate(batch.points):
            self._asked_as.setdefault(x.tobytes(), []).append((batch, i))
        return batch.points

    def _signs(self, n: int) -> Float64:
        return self._rng.choice([-1.0, 1.0], (n, self.dim))

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None
        whole = []
        for x, image in zip(X, features.reshape(len(X), -1, 3), strict=True):
            several = self._asked_as[x.tobytes()]
            batch, i = several.pop(0)
            if not several:
                del self._asked_as[x.tobytes()]
            batch.images[i] = image
            if len(batch.images) == len(batch.points):
                whole.append(batch)
        for batch in whole:
            images = np.array([batch.images[i] for i in range(len(batch.points))])
            self._told += len(images)
            if batch.measures:
                touched = (np.abs(images[1:] - images[0]) > VISIBLE).any(axis=2)
                count = np.maximum(touched.sum(axis=1, keepdims=True), 1)
                self._support, self._paid = (touched / count).astype(np.float32), 0
            else:
                self._paid += len(images)
                self._descend(self._gradient(batch.points, images))
        self._plan()

    def _gradient(self, points: Float64, images: Float32) -> Float64:
        """Mean of the gradients (dim,) of pairs of points (n, dim) with images (n, H W, 3)."""
        assert self.target is not None and self._support is not None
        errors = np.square(images - self.target.reshape(-1, 3)).sum(axis=2)  # (n, H W)
        means = (errors[::2] - errors[1::2]) @ self._support.T  # (pairs, primitives)
        each = np.repeat(means, self.block, axis=1)[:, : self.dim]
        return np.asarray((each / (points[::2] - points[1::2])).mean(axis=0), np.float64)

    def _descend(self, gradient: Float64) -> None:
        """One step of Adam."""
        self._steps += 1
        progress = min(self._told / self.budget, 1.0)
        rate = self.learning_rate * (0.55 + 0.45 * np.cos(np.pi * progress))
        powers = np.stack([gradient, gradient**2])
        betas = np.array(BETAS)[:, None]
        self._moments = betas * self._moments + (1 - betas) * powers
        mean, square = self._moments / (1 - betas**self._steps)
        self._x = np.clip(self._x - rate * mean / (np.sqrt(square) + TINY), 0.0, 1.0)

    def _encode(self, batch: Float32 | None) -> Float32:
        images = needed_images(self.name, batch)
        return images.reshape(len(images), -1).copy()  # a renderer may use its memory again

    def _default_popsize(self) -> int:
        return 8

    def _smallest_popsize(self) -> int:
        return 2
