"""PGPE with ClipUp and the settings of es-clip, as an optimizer of one's own for `moves.py`.

    python benchmarks/moves.py triangles30 --configuration PGPE benchmarks/pgpe.py:PGPE

Sehnke et al. 2010; Toklu et al. 2020, arXiv:2008.02387; Tian and Ha 2022, arXiv:2109.08857.  The
box is four of es-clip's units wide.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

UNIT = 1 / 4
Vector = NDArray[np.float64]


class PGPE:
    """Gradient ascent on the center and the standard deviations of a Gaussian, by ranks."""

    def __init__(self, dim: int, seed: int | None = None, popsize: int = 32) -> None:
        self.popsize, self._rng = popsize, np.random.default_rng(seed)
        self._center, self._velocity = np.full(dim, 0.5), np.zeros(dim)
        self._std = np.full(dim, 0.1 * UNIT)

    def ask(self, n: int) -> Vector:
        """Mirrored samples (n, dim), at the edge of the box where they are beyond it."""
        noise = self._std * self._rng.standard_normal((n // 2, len(self._std)))
        mirrored = np.stack([noise, -noise], axis=1).reshape(n, -1)
        return np.asarray(np.clip(self._center + mirrored, 0, 1))

    def tell(self, X: Vector, losses: Vector) -> None:
        """Follow the gradient of the expected rank, its length fixed and its speed bounded."""
        ranks = np.empty(len(X))
        ranks[np.argsort(losses, kind="stable")] = np.linspace(0.5, -0.5, len(X))
        away = X - self._center
        to_center = ranks @ away / len(X)
        to_std = ranks @ (away**2 - self._std**2) / self._std / len(X)
        length = max(float(np.linalg.norm(to_center)), 1e-300)
        velocity = 0.9 * self._velocity + 0.15 * UNIT * to_center / length
        speed = max(float(np.linalg.norm(velocity)), 1e-300)
        self._velocity = velocity * min(1.0, 0.15 * UNIT / speed)
        self._center = np.clip(self._center + self._velocity, 0, 1)
        change = 0.2 * self._std
        self._std = self._std + np.clip(0.1 * to_std, -change, change)

    def recommend(self) -> Any:
        """The center (dim,)."""
        return self._center.copy()
