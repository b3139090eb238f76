"""What tests of the optimizer share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.fide import FIDE
from fide_plugins.population import Candidate
from fide_plugins.types import Float32, Float64

Render: TypeAlias = Callable[[Float64], Float32]
StateOf: TypeAlias = Callable[[FIDE], bytes]

TINY: Float32 = np.zeros((4, 4, 3), np.float32)
TINY_PAPER: dict[str, Any] = {"preset": "paper", "popsize": 6, "epochs": 1, "batch_size": 6}


def sphere(X: Float64) -> Float64:
    values: Float64 = ((X - 0.3) ** 2).sum(axis=1)
    return values


def run(opt: FIDE, render: Render, generations: int) -> Float64:
    asked = []
    for _ in range(generations):
        X = opt.ask()
        opt.tell(X, render(X))
        asked.append(X)
    return np.concatenate(asked)


def pending_now(opt: FIDE) -> list[Candidate]:
    """Candidates that were asked and not told, in that order."""
    return list(opt.state.population.pending.values())
