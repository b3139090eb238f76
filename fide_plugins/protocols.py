"""What the parts of the library know of each other."""

from __future__ import annotations

import os
from typing import Protocol, Self

from fide_plugins.points import Float64
from fide_plugins.solution import Solution

__all__ = ["Optimizer"]


class Optimizer(Protocol):
    """FIDE and all its rivals: minimize over [0, 1]^dim by ask and tell."""

    dim: int
    popsize: int
    evaluations: int
    """Points told so far."""
    times: dict[str, float]
    """Seconds spent so far in "encode" (losses and features), "train", "search"."""

    @property
    def name(self) -> str:
        """Name in `fide_plugins.optimizers`."""

    @property
    def best(self) -> Solution | None:
        """Best point told so far."""

    def ask(self, n: int | None = None) -> Float64:
        """Candidates (n, dim) in [0, 1]; None: what is left of the generation."""

    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        """Report results: points (n, dim) with their images, losses (n,), or both."""

    def recommend(self) -> Float64:
        """Point (dim,) that the search believes in."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint."""

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Optimizer that goes on from a checkpoint."""
