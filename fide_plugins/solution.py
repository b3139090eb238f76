"""The best candidate of a run."""

from __future__ import annotations

from dataclasses import dataclass

from fide_plugins.images import Float32
from fide_plugins.points import Float64

__all__ = ["Solution"]


@dataclass(frozen=True, eq=False)
class Solution:
    """A candidate that was evaluated.

    x: (dim,) float64, parameters in [0, 1].
    loss: its loss.
    evaluation: index, from 0, of the evaluation that found it.
    image: (H, W, 3) float32 in [0, 1], or None where only the loss was told.
    """

    x: Float64
    loss: float
    evaluation: int
    image: Float32 | None = None
