"""What each exchangeable block contributes to the image.

Block i is overwritten by a copy of another block. Where blocks are exchangeable, and two in one
place look like one, that deletes block i: the loss that it costs is its *removal cost*, and the
tokens that change are the region that it *owns*. One render a block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import array, check
from fide_plugins.types import Float64, Indices

__all__ = ["Removal"]

_MOST = 1e300  # cost


class Removal:
    """Removal costs (n,) and owned regions (n, T) of the blocks of one incumbent."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin again, for another incumbent."""
        self.costs: Float64 = np.empty(0)
        self.owned: Float64 = np.empty((0, 0))

    @property
    def known(self) -> bool:
        """Whether there was a round for the incumbent."""
        return len(self.costs) > 0

    def draw(self, x: Float64, blocks: Indices, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of x (d,), each with one block overwritten by another one."""
        n = len(blocks)
        other = (np.arange(n) + rng.integers(1, n, size=n)) % n
        removed = np.tile(x, (n, 1))
        for row, block, copied in zip(removed, blocks, blocks[other], strict=True):
            row[block] = x[copied]
        return removed

    def learn(
        self,
        incumbent: TrainingSample,
        samples: Sequence[TrainingSample],
        blocks: Indices,
        channels: int | None,
    ) -> None:
        """Learn from renders of what `draw` gave; a block without one costs nothing."""
        self.costs = np.zeros(len(blocks))
        self.owned = np.zeros((len(blocks), len(incumbent.tokens)))
        for sample in samples:
            moved = sample.x != incumbent.x
            touched = np.flatnonzero(moved[blocks].any(axis=1))
            if len(touched) == 1 and moved.sum() == moved[blocks[touched[0]]].sum():
                self.costs[touched[0]] = np.clip(sample.loss - incumbent.loss, -_MOST, _MOST)
                self.owned[touched[0]] = changed(incumbent.tokens, sample.tokens, channels)

    def residual(self, incumbent: TrainingSample, target: Tensor, channels: int | None) -> Float64:
        """Squared error of the image in the tokens that each block owns, (n,)."""
        error = changed(incumbent.tokens, target, channels) ** 2  # (T,)
        part = self.owned**2
        part = part / np.maximum(part.sum(axis=0), 1e-300)
        owned: Float64 = part @ error
        return owned

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"costs": self.costs, "owned": self.owned}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        form = {"costs": array("blocks"), "owned": array("blocks", "tokens", low=0.0)}
        check(state, form, {}, "removal")  # type: ignore[arg-type]
        self.costs, self.owned = state["costs"], state["owned"]


def changed(before: Tensor, after: Tensor, channels: int | None) -> Float64:
    """How much each of the T tokens differs, (T,), Euclidean."""
    difference = (after.to(before.device) - before)[:, :channels].double()
    return np.asarray(difference.square().sum(dim=1).sqrt().cpu().numpy(), np.float64)
