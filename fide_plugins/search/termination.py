"""When a search is over.

A search has *stalled* when its best loss has improved by less than a stated fraction over a stated
number of generations.  It has *collapsed* when it is a thousandth of the box wide, which is exact
enough for another search to begin; one that goes *to the end* collapses only where its samples are
one point, for any renderer.  It is *hopeless* when it has a loss to beat and, at the rate of its
last generations, will not.

A search from hypotheses of a learned model has to be *brisk* as long as its loss is still high: in
the right place it loses a third in every few generations.

That is for a search that images guide: it is quick, and moves have a use for what it found.  A
search by losses only is slow, some of its descents wait long for the covariance, and all that
comes after it is another beginning.  It is over only when it has *converged*: its samples differ by
rounding, as the library `cma` has it, or no sample of very many generations was better.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64

__all__ = [
    "Termination",
    "default_loss_only_patience",
    "default_patience",
    "has_stalled",
    "is_hopeless",
]

_COLLAPSED = 6e-3  # of sigma0: a thousandth of the box for sigma0 = 1/6
_TO_THE_END = 1e-7  # of sigma0: pixels are single precision, and say nothing of smaller steps
_CONVERGED = 1e-11  # of sigma0; `cma`: tolx
_RATE_OVER = 3  # generations
_HORIZON = 8  # generations in which the loss to beat must be within reach
_BENEFIT_OF_DOUBT = 6  # generations
_BRISK_PATIENCE, _BRISK_IMPROVEMENT = 7 / 5, 0.3  # in units of the patience; share of the loss


def default_patience(dim: int, popsize: int) -> int:
    """Generations without progress that end a search: 5, more where each teaches little.

    Few, because moves do more than patience (`search.moves`), and one of them goes on closely.
    """
    return max(5, dim // popsize)


def default_loss_only_patience(dim: int, popsize: int) -> int:
    """Generations without any improvement that end a search by losses only."""
    return 100 + 30 * dim // popsize


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


def is_hopeless(history: list[float], goal: float) -> bool:
    """Whether the best loss, going on as in the last generations, stays above `goal` for long."""
    if len(history) < _BENEFIT_OF_DOUBT or history[-1] <= goal:
        return False
    before, now = history[-1 - _RATE_OVER], history[-1]
    if before == np.inf:
        return now == np.inf
    return now - _HORIZON * (before - now) / _RATE_OVER > goal


class Termination:
    """Of one search, generation by generation.

    sigma0: standard deviation of a search that knows nothing, one number or (d,).
    patience, improvement: of `has_stalled`.
    goal: loss that the search has to beat; +inf for none.
    loss_only_patience: generations without any improvement that end it where no image guides it.
    brisk_above: loss above which it has to be brisk; +inf for none.
    to_the_end: whether it goes on until its samples are one point, for any renderer.
    """

    def __init__(
        self,
        *,
        sigma0: float | Float64,
        patience: int,
        improvement: float,
        goal: float = np.inf,
        loss_only_patience: int = 100,
        brisk_above: float = np.inf,
        to_the_end: bool = False,
    ) -> None:
        self.sigma0, self.patience, self.improvement = sigma0, patience, improvement
        self.goal, self.loss_only_patience = goal, loss_only_patience
        self.brisk_above = brisk_above
        self._narrowest = _TO_THE_END if to_the_end else _COLLAPSED
        self.history: list[float] = []
        """Best loss after each of the last generations, as many as anybody asks for."""

    def note(self, losses: Float64) -> None:
        """Note the losses (k,) of one generation."""
        before = self.history[-1] if self.history else np.inf
        self.history.append(min(before, float(np.min(losses))))
        longest = max(self._brisk_patience, self.loss_only_patience, _BENEFIT_OF_DOUBT)
        del self.history[: -1 - longest]

    @property
    def _brisk_patience(self) -> int:
        return round(_BRISK_PATIENCE * self.patience)

    def is_over(self, std: Float64, *, guided: bool = True) -> bool:
        """Whether to look elsewhere.

        std: (d,), of the search distribution.  guided: whether images guide the search.
        """
        if not guided:
            converged = bool((std < _CONVERGED * self.sigma0).all())
            return converged or has_stalled(self.history, self.loss_only_patience, 0.0)
        collapsed = bool((std < self._narrowest * self.sigma0).all())
        if self.history and self.history[-1] > self.brisk_above:
            stalled = has_stalled(self.history, self._brisk_patience, _BRISK_IMPROVEMENT)
        else:
            stalled = has_stalled(self.history, self.patience, self.improvement)
        return collapsed or stalled or is_hopeless(self.history, self.goal)
