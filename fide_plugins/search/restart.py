"""When a search has come to its end, and where the next one begins.

A search *stalls* when its best loss has improved by less than a stated share over a stated number
of generations, or when its distribution has collapsed.  The next one begins at the center of the
box, knowing nothing: where one of four searches finds the right arrangement of the parts of a
picture and three end in a wrong one, four short searches are worth more than patience with one.
The best point of all searches is kept (`docs/ablation.md` compares this with patience, and with
restarts that begin at the best point).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fide_plugins.points import Float64

__all__ = ["Restarts", "has_stalled"]

_COLLAPSED = 6e-3  # of the initial standard deviation: a thousandth of the box for sigma0 = 1/6


def has_stalled(history: list[float], patience: int, improvement: float) -> bool:
    """Whether the last `patience` generations lowered the best loss by less than `improvement`.

    history: best loss of the search after each of its generations, never rising.
    improvement: as a share of the loss.
    """
    if len(history) <= patience:
        return False
    before, now = history[-1 - patience], history[-1]
    if before == np.inf:
        return now == np.inf
    return not now < before - improvement * abs(before)


class Restarts:
    """The policy: notes how a search goes, says when it is over, and where the next one begins.

    Parameters
    ----------
    dim : number of parameters.
    sigma0 : standard deviation at the beginning of a search.
    enabled : False for one search, to the end.
    patience, improvement : of `has_stalled`.
    """

    def __init__(
        self,
        dim: int,
        sigma0: float,
        *,
        enabled: bool = True,
        patience: int = 20,
        improvement: float = 0.1,
    ) -> None:
        self.dim, self.sigma0, self.enabled = dim, sigma0, enabled
        self.patience, self.improvement = patience, improvement
        self.searches = 0  # begun so far
        self._history: list[float] = []  # best loss after each generation of this search

    def begin(self) -> tuple[Float64, Float64]:
        """Mean and standard deviation (d,) of a search that knows nothing."""
        self.searches += 1
        self._history = []
        return np.full(self.dim, 0.5), np.full(self.dim, self.sigma0)

    def note(self, losses: Float64) -> None:
        """Note the losses (k,) of one generation."""
        before = self._history[-1] if self._history else np.inf
        self._history.append(min(before, float(np.min(losses))))

    def is_over(self, std: Float64) -> bool:
        """Whether to begin another search; std: (d,), of the present distribution."""
        if not self.enabled:
            return False
        collapsed = std.max() < _COLLAPSED * self.sigma0
        return bool(collapsed) or has_stalled(self._history, self.patience, self.improvement)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"searches": self.searches, "history": np.array(self._history, np.float64)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self.searches, self._history = int(state["searches"]), state["history"].tolist()
