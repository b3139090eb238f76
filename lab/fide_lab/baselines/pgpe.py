"""PGPE with ClipUp: the optimizer of es-clip, which draws pictures by triangles.

Policy gradients with parameter-based exploration (Sehnke et al. 2010, 10.1016/j.neunet.2009.12.004)
follow the gradient of the expected rank of a sample of N(c, diag(sigma^2)) to c and sigma.  ClipUp
(Toklu et al. 2020, arXiv:2008.02387) gives each gradient of c the same length, and bounds the
speed.  The settings are those of es-clip (Tian and Ha 2022, arXiv:2109.08857): 0.1, 0.15 and 0.15
for the standard deviation, the rate and the speed, in a space without bounds.  Here the box is four
of their units wide.

Notation: k candidates x (k, d), c + sigma z and c - sigma z in turn; s (k,) their centered ranks,
from 1/2 for the best to -1/2; v (d,) the velocity.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.replay import Replayed
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import fraction, positive

__all__ = ["PGPE"]

_UNIT = 1 / 4  # of the box: one unit of es-clip's space
_LARGEST_CHANGE = 0.2  # of a standard deviation in a generation, as in pgpelib


class PGPE(Replayed):
    """Gradient ascent on a Gaussian's center and standard deviations; options of `Baseline`.

    popsize: candidates a generation, an even number; None: es-clip's 256.
    rate: length of the step to which each gradient of the center is scaled, in units of the box.
    max_speed: longest step of the center in a generation, in units of the box.
    momentum: share of the velocity that stays, in [0, 1].
    std_rate: learning rate of the standard deviations.

    Candidates beyond the box are moved to its edge, and count as where they were rendered.

    Raises OptionError (a ValueError) for options out of range.
    """

    name: ClassVar[str] = "pgpe"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        sigma0: float = 0.1 * _UNIT,
        rate: float = 0.15 * _UNIT,
        max_speed: float = 0.15 * _UNIT,
        momentum: float = 0.9,
        std_rate: float = 0.1,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, sigma0=sigma0, **options)
        if self.popsize % 2:
            raise OptionError(f"popsize must be even, for mirrored samples; not {self.popsize}")
        self.rate, self.max_speed = positive("rate", rate), positive("max_speed", max_speed)
        self.momentum = fraction("momentum", momentum)
        self.std_rate = positive("std_rate", std_rate)
        self._rng = np.random.default_rng(self.seed)
        self._center = np.full(self.dim, 0.5)
        self._std = np.full(self.dim, self.sigma0)
        self._velocity = np.zeros(self.dim)

    def recommend(self) -> Float64:
        """Center (dim,) of the distribution."""
        return self._center.copy()

    def _sample(self) -> Float64:
        noise = self._std * self._rng.standard_normal((self.popsize // 2, self.dim))
        mirrored = np.stack([noise, -noise], axis=1).reshape(self.popsize, self.dim)
        samples: Float64 = np.clip(self._center + mirrored, 0, 1)
        return samples

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        ranks = _centered_ranks(losses)
        away = X - self._center
        to_center = ranks @ away / len(X)
        to_std = (ranks - ranks.mean()) @ (away**2 - self._std**2) / self._std / len(X)
        self._velocity = self._clip_up(to_center)
        self._center = np.clip(self._center + self._velocity, 0, 1)
        change = _LARGEST_CHANGE * self._std
        self._std = self._std + np.clip(self.std_rate * to_std, -change, change)

    def _clip_up(self, gradient: Float64) -> Float64:
        """Next velocity (d,): the gradient scaled to one length, and the speed bounded."""
        length = float(np.linalg.norm(gradient))
        step = self.rate * gradient / length if length > 0 else gradient
        velocity = self.momentum * self._velocity + step
        speed = float(np.linalg.norm(velocity))
        return velocity * (self.max_speed / speed) if speed > self.max_speed else velocity

    def _default_popsize(self) -> int:
        return 256

    def _smallest_popsize(self) -> int:
        return 2

    def _own_settings(self) -> dict[str, Any]:
        names = ("rate", "max_speed", "momentum", "std_rate")
        return {name: getattr(self, name) for name in names}


def _centered_ranks(losses: Float64) -> Float64:
    """Ranks (k,) from 1/2 for the lowest loss to -1/2 for the highest; equal ones as they come."""
    ranks = np.empty(len(losses))
    ranks[np.argsort(losses, kind="stable")] = np.linspace(0.5, -0.5, len(losses))
    return ranks
