"""Uniform random search: what every other optimizer has to beat."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.replay import Replayed
from fide_plugins.types import Float32, Float64

__all__ = ["Random"]


class Random(Replayed):
    """Independent points from the uniform distribution on [0, 1]^dim; options of `Baseline`.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "random"

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        self._rng = np.random.default_rng(self.seed)

    def _sample(self) -> Float64:
        return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        pass
