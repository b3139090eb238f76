"""One search, from its start until it is over: a distribution, what it stands for, when to stop.

A candidate has two forms: z is what the distribution drew and learns from, x is the point of the
unit cube that is rendered.  The maps between them are those of `mixed`.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fide_plugins.options import Options
from fide_plugins.population import Candidate, mirrored_pair, search_columns
from fide_plugins.runtime.schema import (
    Plain,
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    each,
    maybe,
    real,
    side,
)
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.mixed import Axes, closest
from fide_plugins.search.moves import Start
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.search.validity import Validity


_COLLAPSED = 6e-3  # of sigma0: a thousandth of the box for sigma0 = 1/6
_TO_THE_END = 1e-7  # of sigma0: pixels are single precision, and say nothing of smaller steps
_CONVERGED = 1e-11  # of sigma0; `cma`: tolx
_RATE_OVER = 3  # generations
_HORIZON = 8  # generations in which the loss to beat must be within reach
_BENEFIT_OF_DOUBT = 6  # generations
_STRICT_PATIENCE, _STRICT_IMPROVEMENT = 7 / 5, 0.3  # in units of the patience; share of the loss


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


@dataclass
class Termination(Stateful):
    """When one search is over.

    Guided by images, it is over when it has *stalled* (`has_stalled`), *collapsed* (it is a
    thousandth of the box wide), or is *hopeless* (`is_hopeless`).  By losses only it is slow, and
    over when it has converged, or no sample of very many generations was better.

    sigma0: standard deviation of a search that knows nothing, one number or (d,).
    patience, improvement: of `has_stalled`.
    goal: loss that the search has to beat; +inf for none.
    loss_only_patience: generations without any improvement that end it where no image guides it.
    strict_above: loss above which it has to lose a third in every few generations; +inf for none.
    to_the_end: whether it goes on until its samples are one point, for any renderer.
    history: best loss after each of the last generations, as many as are needed.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {"history": each(real(high=np.inf))}
    sigma0: float | Float64
    patience: int
    improvement: float
    goal: float = np.inf
    loss_only_patience: int = 100
    strict_above: float = np.inf
    to_the_end: bool = False
    history: list[float] = field(default_factory=list)

    def note(self, losses: Float64) -> None:
        """Note the losses (k,) of one generation."""
        before = self.history[-1] if self.history else np.inf
        self.history.append(min(before, float(np.min(losses))))
        strict = round(_STRICT_PATIENCE * self.patience)
        del self.history[: -1 - max(strict, self.loss_only_patience, _BENEFIT_OF_DOUBT)]

    def is_over(self, std: Float64, *, guided: bool = True, floor: float = 0.0) -> bool:
        """Whether to begin another search; guided: whether images guide it.

        std: (d,), of the search distribution.  floor: loss that no candidate removes.
        """
        if not guided:
            converged = bool((std < _CONVERGED * self.sigma0).all())
            return converged or has_stalled(self.history, self.loss_only_patience, 0.0)
        narrowest = _TO_THE_END if self.to_the_end else _COLLAPSED
        above = [loss - floor for loss in self.history]
        strict = bool(self.history and self.history[-1] > self.strict_above)
        progress = self.patience, self.improvement
        if strict:
            progress = round(_STRICT_PATIENCE * self.patience), _STRICT_IMPROVEMENT
        return (
            bool((std < narrowest * self.sigma0).all())
            or has_stalled(above, *progress)
            or is_hopeless(self.history, self.goal)
        )


@dataclass(frozen=True)
class Setting:
    """What all searches of a run have in common.

    popsize: k; a start may multiply it.
    sigma0: (d,), standard deviation of the first search.
    options: `guard_search`, `patience`, `improvement`.
    axes: of the cube.
    validity: which points may be rendered; None: all.
    """

    popsize: int
    sigma0: Float64
    options: Options
    axes: Axes
    validity: Validity | None = None


class Search(Stateful):
    """A search distribution, refined until it stalls, collapses, or has no hope.

    start: where it begins.  goal: loss that it has to beat; +inf for none.
    stretch: A (d,), see `mixed`; None where no axis has cells.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "popsize": side("popsize"),
        "distribution": anything,  # which checks its own
        "stretch": maybe(array("d", low=1e-30, high=1e30)),
        "termination": anything,
    }

    def __init__(self, start: Start, goal: float, setting: Setting) -> None:
        self.setting = setting
        self.popsize = start.population * setting.popsize
        self._guard = setting.options.guard_search
        self.axes, self._start, std = setting.axes, start, start.std
        self.stretch = None if self.axes.discrete is None else np.ones(self.axes.dim)
        if np.array_equal(std, setting.sigma0):  # nothing is known
            std = self.axes.widened(std)
        widest = start.widest if self._guard else np.inf
        self.distribution = CMAES(start.mean, std, self.popsize, widest=widest)
        dim, options = len(start.mean), setting.options
        patience = options.patience or max(5, dim // self.popsize)  # each may teach little
        self.termination = Termination(
            sigma0=setting.sigma0,
            patience=start.patience * patience,
            improvement=start.improvement * options.improvement,
            goal=goal,
            loss_only_patience=100 + 30 * dim // self.popsize,
            strict_above=np.inf if start.strict_above is None else start.strict_above,
            to_the_end=start.to_the_end,
        )

    @property
    def mean(self) -> Float64:
        """Mean (d,) of the distribution."""
        return self.distribution.mean

    @property
    def std(self) -> Float64:
        """Standard deviations (d,) of what is rendered."""
        std = self.distribution.std
        return std if self.stretch is None else self.stretch * std

    def sample(
        self, n: int, rng: np.random.Generator, *, checked: bool = True
    ) -> tuple[Float64, Float64]:
        """Draw n candidates z ~ N(m, Sigma), and the points x that they stand for, (n, d) each.

        checked: whether all must satisfy the constraints.
        """
        validity = self.setting.validity
        if validity is None or not checked:
            z = self.distribution.sample(n, rng)
            return self._with_fixed(self.axes.reflected(self.stretched(z))), z
        x, z, invalid = validity.sample(lambda m: self.sample(m, rng, checked=False), n)
        if invalid.any():  # towards the nearest of those that are valid
            start = self._start.mean
            valid = x[~invalid] if not invalid.all() else start[None]
            nearest = np.linalg.norm(x[:, None] - valid, axis=2).argmin(axis=1)
            x = validity.moved_back(x, valid[nearest], start)
            z[invalid] = self.distribution.shortened(self.closest(x[invalid]))
        return x, z

    def stretched(self, z: Float64) -> Float64:
        """Candidates z (n, d) as samples of N(mean, std^2), before any are put into the cube."""
        return z if self.stretch is None else self.mean + self.stretch * (z - self.mean)

    def place_proposals(self, x: Float64, z: Float64) -> Float64:
        """Points of the cube for proposals x (n, d), with the values that this search fixes.

        z: (n, d), samples of which they were made.
        """
        x, validity = self._with_fixed(self.axes.clipped(x)), self.setting.validity
        if validity is None:
            return x
        sampled = self._with_fixed(self.axes.reflected(self.stretched(z)))
        return validity.moved_back(x, sampled, self._start.mean)

    def _with_fixed(self, x: Float64) -> Float64:
        """Points (n, d) with the coordinates of the start on the axes that are fixed."""
        fixed = self._start.fixed
        return x if fixed is None else np.where(fixed, self._start.mean, x)

    def closest(self, x: Float64) -> Float64:
        """Return the z (n, d) of points x (n, d) that is closest to the mean."""
        mean, discrete = self.mean, self.axes.discrete
        v = closest(x, mean, self.axes.periodic)
        if self.stretch is None or discrete is None:
            return v
        return mean + (np.where(discrete, x, v) - mean) / self.stretch

    def tell(
        self, members: list[Candidate], losses: Float64, point: tuple[Float64, float] | None
    ) -> None:
        """Learn from the members of a generation and their losses (k,).

        point: x (d,) and loss of one that is no member; it takes the place of the worst member if
            it is better.
        """
        self.termination.note(losses)
        z, injected = search_columns(members)  # new arrays
        worst = int(np.argmax(losses))
        if point is not None and point[1] < losses[worst]:
            losses = losses.copy()  # those given are the caller's
            z[worst], losses[worst] = self.closest(point[0][None])[0], point[1]
            injected[worst] = True
        pair = mirrored_pair(members) if self.distribution.draws_pair else None
        if pair is not None and injected[list(pair)].any():
            pair = None
        self.distribution.tell(z, losses, injected & self._guard, pair)
        self._correct()

    def preview(self, members: list[Candidate], losses: Float64) -> Search:
        """Return what `tell` would make of the search now, with a part of a generation."""
        z, injected = search_columns(members)
        other = copy.copy(self)
        other.distribution = self.distribution.preview(z, losses, injected & self._guard)
        other._correct()
        return other

    def _correct(self) -> None:
        """Apply the margin, and move the mean back to what is fixed."""
        if self.stretch is not None:
            self.stretch = self.axes.correct(self.distribution, self.stretch)
        self.distribution.mean = self._with_fixed(self.distribution.mean)

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Go on where `state_dict` was taken; ValueError if it is none."""
        if (state.get("stretch") is None) != (self.stretch is None):
            raise ValueError("search['stretch'] is not of this space")
        super().load_state_dict(state)

    def _sides(self) -> Sides:
        return {"popsize": self.popsize, "d": len(self.mean)}
