"""The trust region: how large it is, and the candidates in it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import ceil
from typing import Any

import torch
from torch import Tensor

from fide_plugins.runtime.schema import Schema, real, whole

__all__ = ["REGION", "Region", "candidates"]

FIRST, LARGEST = 0.8, 1.6  # side of the box, before the lengthscales
SMALLEST = 0.5**7  # that of the authors' program
SUCCESSES = 3  # rounds with progress in a row, after which it doubles
PROGRESS = 1e-3  # of the best value, which a round must at least bring
CHANGED = 20  # parameters of a candidate that differ from the best point's, on average


@dataclass
class Region:
    """Side of the box, and the rounds in a row with progress and without it."""

    length: float = FIRST
    successes: int = 0
    failures: int = 0

    def judge(self, before: float, now: float, dim: int, popsize: int) -> None:
        """Adapt the side to the best value `before` a round of `popsize` points, and in it."""
        if now < before - PROGRESS * abs(before):
            self.successes, self.failures = self.successes + 1, 0
        else:
            self.successes, self.failures = 0, self.failures + 1
        if self.successes == SUCCESSES:
            self.length, self.successes = min(2.0 * self.length, LARGEST), 0
        elif self.failures >= ceil(max(4.0, dim) / popsize):
            self.length, self.failures = self.length / 2.0, 0

    def as_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return asdict(self)


REGION: Schema = {
    "length": real(0.0, LARGEST),
    "successes": whole(0, SUCCESSES),
    "failures": whole(),
}


def candidates(
    best: Tensor, lengthscales: Tensor, length: float, n: int, generator: torch.Generator
) -> Tensor:
    """Points (n, d) in the unit cube and in the box of that side around `best` (d,).

    lengthscales: (d,); the sides are proportional to them, and their product is length^d.
    """
    d = len(best)
    weights = lengthscales / lengthscales.log().mean().exp()
    low = (best - weights * length / 2).clamp(0.0, 1.0)
    high = (best + weights * length / 2).clamp(0.0, 1.0)
    seed = int(torch.randint(2**31, (), generator=generator))
    sobol = torch.quasirandom.SobolEngine(d, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    points: Tensor = low + (high - low) * sobol.draw(n, dtype=best.dtype)
    change = torch.rand(n, d, generator=generator) <= CHANGED / d
    at_least = torch.randint(d, (n,), generator=generator)
    change[torch.arange(n), at_least] |= ~change.any(dim=1)
    return torch.where(change, points, best)
