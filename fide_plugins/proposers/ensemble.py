"""Two proposers, the inverse model and the forward model, and how many proposals each makes.

The linear proposer (`proposers.linear`) predicts parameters from features; it needs few candidates,
averages over the distribution, and so looks at the whole.  The forward model (`proposers.forward`)
predicts features from parameters; it converges much faster where images are smooth, and settles for
the next local optimum where they are not.  Neither is better everywhere, so both propose, and how
they rank within each generation decides the fraction of either: that of the forward model rises by
`rate` times its lead in mean rank, and stays within limits, so that each is always tried.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from torch import Tensor

from fide_plugins.population import Makers
from fide_plugins.proposers.base import Previewed, Proposals
from fide_plugins.proposers.forward import ForwardProposer
from fide_plugins.proposers.image_gate import adapt_fraction
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.runtime.schema import Schema, Sides, anything, check, real
from fide_plugins.types import Float64

__all__ = ["FORWARD", "INVERSE", "EnsembleProposer"]

_SCHEMA: Schema = {"inverse": anything, "forward": anything, "fraction": real(0.0, 1.0)}
INVERSE, FORWARD = 1, 2  # makers of candidates


class EnsembleProposer(Previewed):
    """The inverse and the forward model side by side.

    inverse, forward: the proposers.
    fraction: of proposals that the forward model makes at first.
    smallest: of the proposals, that either makes at least.
    rate: of the adaptation, see `proposers.image_gate`; 0 keeps the fraction.
    """

    background = False
    busy = False
    singly = True

    def __init__(
        self,
        inverse: LinearProposer,
        forward: ForwardProposer,
        *,
        fraction: float = 0.5,
        smallest: float = 0.1,
        rate: float = 0.2,
    ) -> None:
        self.inverse, self.forward = inverse, forward
        self.fraction, self.smallest, self.rate = fraction, smallest, rate

    @property
    def ready(self) -> bool:
        """Whether one of them can be asked."""
        return self.inverse.ready or self.forward.ready

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Both remember candidates x (n, d), tokens (n, T, C) of their images, losses (n,)."""
        self.inverse.update(x, tokens, losses, std)
        self.forward.update(x, tokens, losses, std)

    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Candidates (m, d); see `Proposer`."""
        return self.proposals(z, target, mean, std, rng).x

    def proposals(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Proposals:
        """Candidates and who made each; see `Proposer`."""
        makers = self.choose(len(z), rng)
        return Proposals(self.propose_by(makers, z, target, mean, std, rng), makers)

    def choose(self, m: int, rng: np.random.Generator) -> Makers:
        """Draw who makes each of m proposals, (m,)."""
        if not (self.inverse.ready and self.forward.ready):
            return np.full(m, FORWARD if self.forward.ready else INVERSE)
        return np.where(rng.random(m) < self.fraction, FORWARD, INVERSE)

    def propose_by(
        self,
        makers: Makers,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator,
    ) -> Float64:
        """As `propose`, each candidate by its maker (m,)."""
        x = np.empty_like(z)
        for maker, proposer in ((INVERSE, self.inverse), (FORWARD, self.forward)):
            if (mine := makers == maker).any():
                x[mine] = proposer.propose(z[mine], target, mean, std, rng)
        return x

    def note_ranks(self, losses: Float64, makers: Makers) -> None:
        """Note how proposals rank, by losses (k,) of a generation and who made each, (k,)."""
        proposed = makers > 0
        if self.rate and proposed.any():
            self.fraction = adapt_fraction(
                self.fraction,
                losses[proposed],
                makers[proposed] == FORWARD,
                smallest=self.smallest,
                largest=1 - self.smallest,
                rate=self.rate,
            )

    def forget(self) -> None:
        """Another search begins; which of them is better here is not forgotten."""
        self.inverse.forget()
        self.forward.forget()

    def copy(self) -> Self:
        """Another with the same buffers, which can be updated without this one."""
        other = copy.copy(self)
        other.inverse, other.forward = self.inverse.copy(), self.forward.copy()
        return other

    def state_dict(self) -> dict[str, Any]:
        """The buffers and the fraction."""
        return {
            "inverse": self.inverse.state_dict(),
            "forward": self.forward.state_dict(),
            "fraction": self.fraction,
        }

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none."""
        check(state, _SCHEMA, {}, "proposer")
        self.inverse.load_state_dict(state["inverse"], sides)
        self.forward.load_state_dict(state["forward"], sides)
        self.fraction = float(state["fraction"])
