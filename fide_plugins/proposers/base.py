"""What a proposer is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.runtime.schema import Plain, Sides
from fide_plugins.types import Float64


class Proposer(ABC):
    """Learns parameters from images, and is asked for those of the target (lines 5 and 8).

    lazy: whether each proposal is made when it is asked for, from all that was told by then.
    """

    lazy = False

    @property
    @abstractmethod
    def ready(self) -> bool:
        """Whether it can be asked."""

    @abstractmethod
    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> object:
        """Learn from candidates x (n, d), tokens (n, T, C) of their images, losses (n,).

        std: (d,), sqrt(diag Sigma) of the search distribution.
        """

    @abstractmethod
    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Candidates (m, d), from samples z (m, d) and the target's tokens (T, C).

        mean, std: (d,), of the distribution of z.  Values may leave the unit cube.
        """

    @abstractmethod
    def forget(self) -> None:
        """Another search begins."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that `update` changes."""

    @abstractmethod
    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.  sides: T and C, if known."""
