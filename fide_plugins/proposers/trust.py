"""How far images are believed: whether they guide the search at all, and how many are proposed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from fide_plugins.points import Float64
from fide_plugins.presets import Options
from fide_plugins.proposers.agreement import Agreement
from fide_plugins.proposers.share import adapt_share

__all__ = ["Trust"]


class Trust:
    """Judged by what was told.

    options: `guard_images`, and the `share` and its limits.
    views: as of `Agreement`.
    """

    def __init__(self, options: Options, views: tuple[int | None, ...]) -> None:
        self.options = options
        self.share = options.share
        """Of a generation that is proposed, where images are followed wholly."""
        self._agreement = Agreement(views)

    @property
    def strength(self) -> float:
        """How far images are followed, in [0, 1]; where they are not, the search is CMA-ES."""
        return self._agreement.strength if self.options.guard_images else 1.0

    @property
    def guided(self) -> bool:
        """Whether images say when a search is over, and where to go on."""
        return self.strength == 1.0

    def number(self, popsize: int, rng: np.random.Generator) -> int:
        """How many of a generation to propose, at random around the share of it."""
        share = self.share * self.strength
        return min(int(share * popsize + rng.random()), popsize - 1) if share else 0

    def note_images(self, tokens: Tensor, target: Tensor, losses: Float64) -> None:
        """Note tokens (n, T, C) of a generation's images, those of the target, losses (n,)."""
        if self.options.guard_images:
            self._agreement.note(tokens, target, losses)

    def note_ranks(self, losses: Float64, proposed: npt.NDArray[np.bool_]) -> None:
        """Note how proposed candidates (k,) of a generation rank, by all its losses (k,)."""
        o = self.options
        if o.share_rate:
            self.share = adapt_share(
                self.share,
                losses,
                proposed,
                smallest=o.smallest_share,
                largest=o.largest_share,
                rate=o.share_rate,
            )

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"share": self.share, **self._agreement.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self.share = float(state["share"])
        self._agreement.load_state_dict(state)
