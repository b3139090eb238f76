"""Stochastic gradient estimation per pixel (Deliot, Heitz and Belcour 2024, arXiv:2404.09758).

All parameters are moved at once, by random signs: two renders, at x + e s and x - e s, give the
difference of the squared error of each pixel.  A pixel depends on few parameters, so the gradient
of a parameter is averaged over the pixels that it touches, its support, and Adam descends.  Their
rasterizer says by an ID buffer which primitive a pixel shows; here the support of a primitive is
measured: one render in which its parameters are moved, beside one of x.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline, needed_images
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive, positive_fraction
from fide_plugins.validation.points import whole_number

VISIBLE = 1 / 512  # change of a channel from which on a pixel is touched
BETAS, TINY = (0.9, 0.999), 1e-8  # of Adam


class SGE(Baseline):
    """Gradients of all parameters from two renders, averaged over the pixels that each touches.

    block: parameters of a primitive, which follow each other and have one support (Voronoi: 5,
        triangles: 10).
    pairs: of renders for a step.
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
        pairs: int = 4,
        epsilon: float = 0.015,
        learning_rate: float = 0.03,
        share: float = 0.2,
        budget: int = 10_000,
        **options: Any,
    ) -> None:
        self.pairs = whole_number("pairs", pairs, 1)
        super().__init__(dim, target, **options)
        if self.target is None:
            raise ImageError(f"{self.name} learns from images and needs a target; got none")
        self.block = whole_number("block", block, 1)
        self.epsilon = positive("epsilon", epsilon)
        self.learning_rate = positive("learning_rate", learning_rate)
        self.share = positive_fraction("share", share)
        self.budget = whole_number("budget", budget, 1)
        self._rng = np.random.default_rng(self.seed)
        start = 0.5 + self.sigma0 * self._rng.standard_normal(self.dim)
        self._x = np.clip(start, 0.0, 1.0)
        self._moments = np.zeros((2, self.dim))
        self._steps = self._paid = 0  # steps of Adam; renders of pairs since the last measurement
        self._primitives = -(-self.dim // self.block)
        self._support: Float32 | None = None  # (primitives, H W), rows that add up to 1
        self.measuring = False
        """Whether the candidates of this generation measure supports."""

    def recommend(self) -> Float64:
        """The point (dim,) from which it descends."""
        return self._x.copy()

    def _sample(self) -> Float64:
        cost = (self._primitives + 1) * (1 - self.share) / self.share
        self.measuring = self._support is None or self._paid >= cost
        if self.measuring:
            moved = np.repeat(self._x[None], self._primitives + 1, axis=0)
            signs = self._signs(1)[0]
            for i in range(self._primitives):
                own = slice(i * self.block, (i + 1) * self.block)
                moved[i + 1, own] += self.epsilon * signs[own]
        else:
            signs = self._signs(self.pairs)
            away = self.epsilon * np.stack([signs, -signs], axis=1).reshape(-1, self.dim)
            moved = self._x + away
        return np.clip(moved, 0.0, 1.0)

    def _signs(self, n: int) -> Float64:
        """Random signs (n, dim)."""
        return self._rng.choice([-1.0, 1.0], (n, self.dim))

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        assert features is not None and self.target is not None
        self._population.forget_pending()  # a pair belongs to one point
        if len(X) != len(self._asked) or not np.array_equal(X, self._asked):
            return  # some of an earlier generation: no pairs
        images = features.reshape(len(X), -1, 3)
        if self.measuring:
            touched = (np.abs(images[1:] - images[0]) > VISIBLE).any(axis=2)
            self._support = touched / np.maximum(touched.sum(axis=1, keepdims=True), 1)
            self._paid = 0
            return
        self._paid += len(X)
        errors = np.square(images - self.target.reshape(-1, 3)).sum(axis=2)  # (2 pairs, H W)
        between = errors[::2] - errors[1::2]
        apart = X[::2] - X[1::2]  # (pairs, dim), not 0
        means = np.repeat(between @ self._support.T, self.block, axis=1)[:, : self.dim]
        self._descend((means / apart).mean(axis=0))

    def _descend(self, gradient: Float64) -> None:
        """One step of Adam."""
        self._steps += 1
        progress = min(self.evaluations / self.budget, 1.0)
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
        return 2 * self.pairs
