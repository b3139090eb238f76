"""When a search has come to its end, and where the next one begins.

A search *stalls* when its best loss has improved by less than a stated share over a stated number
of generations, or when its distribution has collapsed.  Then:

- The *first* search, and any whose result is no better than what was found before, is over.
- A *partial* restart begins at the best point so far, narrow in all parameters but one group,
  which gets its initial spread back.  The group is read off the images: parameters that move the
  same parts of the picture belong together, so one of them is drawn and the others follow with a
  probability equal to their overlap with it.  This is what gets a cell, a bead or a joint out of
  the place where it is stuck without throwing the others away.
- A *full* restart begins at the center again, knowing nothing.

Where one of eight searches finds the right arrangement and seven end in a wrong one, the eight are
worth more than patience with one; where the loss has one long valley, going on from the best point
is.  A scene does not say which it is, so "mixed" spends the same number of renders on both kinds.

A partial search is abandoned early when, at the rate of its last generations, it will not get
below the best loss within a stated number of generations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fide_plugins.points import Float64

__all__ = ["Restarts", "has_stalled", "is_hopeless", "overlap", "related_parameters"]

_TINY = 1e-300
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


def is_hopeless(history: list[float], goal: float, horizon: int, window: int = 3) -> bool:
    """Whether `goal` is out of reach of the next `horizon` generations.

    The loss is taken to go on falling by the factor a generation of the last `window`.
    """
    if len(history) <= window or history[-1] <= goal:
        return False
    before, now = history[-1 - window], history[-1]
    if not (0 < now < np.inf and before < np.inf):
        return False  # the rate has no meaning: let it go on
    rate = max(0.0, np.log(before / now)) / window
    return bool(now * np.exp(-rate * horizon) > goal)


def overlap(energy: Float64) -> Float64:
    """Cosine between the regions that parameters move, (d, d), from their energy (T, d)."""
    unit = energy / np.maximum(np.linalg.norm(energy, axis=0), _TINY)
    cosines: Float64 = unit.T @ unit
    return cosines


def related_parameters(overlaps: Float64, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Mask (d,) of one random parameter and those that go along with it."""
    first = int(rng.integers(len(overlaps)))
    group: npt.NDArray[np.bool_] = rng.random(len(overlaps)) < overlaps[first]
    group[first] = True
    return group


class Restarts:
    """The policy: notes how a search goes, says when it is over, and where the next one begins.

    Parameters
    ----------
    dim : number of parameters.
    sigma0 : standard deviation at a full restart.
    mode : "mixed", "partial", "full" or "none" (one search, to the end).
    patience, improvement : of `has_stalled`.
    horizon : of `is_hopeless`.
    group_std, rest_std : standard deviations of a partial restart, in its group and outside.
    """

    def __init__(
        self,
        dim: int,
        sigma0: float,
        *,
        mode: str = "mixed",
        patience: int = 20,
        improvement: float = 0.1,
        horizon: int = 8,
        group_std: float = 0.15,
        rest_std: float = 0.01,
    ) -> None:
        self.dim, self.sigma0, self.mode = dim, sigma0, mode
        self.patience, self.improvement, self.horizon = patience, improvement, horizon
        self.group_std, self.rest_std = group_std, rest_std
        self.searches = 1  # begun so far
        self._history: list[float] = []  # best loss after each generation of this search
        self._goal = np.inf  # what a partial search has to beat
        self._spent = {"full": 0, "partial": 0}  # candidates told, by the kind of their search
        self._energy: Float64 | None = None  # [T, d], of the best search

    def begin_full(self) -> tuple[Float64, Float64]:
        """Mean and standard deviation (d,) of a search that knows nothing."""
        self._history, self._goal = [], np.inf
        return np.full(self.dim, 0.5), np.full(self.dim, self.sigma0)

    def note(self, losses: Float64) -> None:
        """Note the losses (k,) of one generation."""
        before = self._history[-1] if self._history else np.inf
        self._history.append(min(before, float(np.min(losses))))
        self._spent["partial" if self._goal < np.inf else "full"] += len(losses)

    def is_over(self, std: Float64) -> bool:
        """Whether to begin another search; std: (d,), of the present distribution."""
        if self.mode == "none":
            return False
        collapsed = std.max() < _COLLAPSED * self.sigma0
        hopeless = is_hopeless(self._history, self._goal, self.horizon)
        return collapsed or hopeless or has_stalled(self._history, self.patience, self.improvement)

    def begin_next(
        self, best: Float64, loss: float, energy: Float64 | None, rng: np.random.Generator
    ) -> tuple[Float64, Float64]:
        """Mean and standard deviation (d,) of the next search.

        best, loss: of the best point so far, (d,).
        energy: (T, d), what each parameter moves in each part of the image, by the search that
            just ended; None where no image was seen, and then the restart is full.
        """
        self.searches += 1
        if self._history and self._history[-1] <= loss and energy is not None:
            self._energy = energy
        behind = self._spent["partial"] <= self._spent["full"]
        if self._energy is None or self.mode == "full" or (self.mode == "mixed" and not behind):
            return self.begin_full()
        group = related_parameters(overlap(self._energy), rng)
        self._history, self._goal = [], loss
        return best.copy(), np.where(group, self.group_std, self.rest_std)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {
            "searches": self.searches,
            "history": np.array(self._history, np.float64),
            "goal": self._goal,
            "spent": self._spent,
            "energy": self._energy,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave."""
        self.searches, self._goal = int(state["searches"]), float(state["goal"])
        self._history, self._energy = state["history"].tolist(), state["energy"]
        self._spent = dict(state["spent"])
