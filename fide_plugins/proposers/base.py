"""What a proposer is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol, Self

import numpy as np
from torch import Tensor

from fide_plugins.runtime.schema import Sides
from fide_plugins.types import Float64

__all__ = ["Previewed", "Proposer", "ProposerDefaults"]


class Proposer(Protocol):
    """Learns parameters from images, and is asked for those of the target (lines 5 and 8)."""

    @property
    def background(self) -> bool:
        """Whether it learns while the user renders, and should be asked late."""

    @property
    def lazy(self) -> bool:
        """Whether each proposal is made when it is asked for, from all that was told by then."""

    @property
    def busy(self) -> bool:
        """Whether it learns right now."""

    @property
    def ready(self) -> bool:
        """Whether it can be asked."""

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> object:
        """Learn from candidates x (n, d), tokens (n, T, C) of their images, losses (n,).

        std: (d,), sqrt(diag Sigma) of the search distribution.
        """

    def propose(
        self,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator,
    ) -> Float64:
        """Candidates (m, d), from samples z (m, d) and the target's tokens (T, C).

        mean, std: (d,), of the distribution of z.  Values may leave the unit cube.
        """

    def forget(self) -> None:
        """Another search begins."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that `update` changes."""

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.

        sides: T and C of the tokens of an image, by these names, if they are known.
        """

    def preview(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> Proposer:
        """What `update` would make of it now, without changing it; itself if that takes long."""


class ProposerDefaults(ABC):
    """What most proposers have in common."""

    background = False
    lazy = False

    @property
    def busy(self) -> bool:
        """It learns while the caller waits."""
        return False

    @abstractmethod
    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """See `Proposer.propose`."""


class Previewed(ABC):
    """A proposer that learns in no time, so that a preview of what it would learn costs little."""

    @abstractmethod
    def copy(self) -> Self:
        """Another with the same buffers, which can be updated without this one."""

    @abstractmethod
    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """See `Proposer.update`."""

    def preview(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> Self:
        """Another with the same buffers, that was updated."""
        other = self.copy()
        other.update(x, tokens, losses, std)
        return other
