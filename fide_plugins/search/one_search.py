"""One search, from its start until it is over: a distribution, what it stands for, when to stop.

A candidate has two forms: z is what the distribution drew and learns from, x is the point of the
unit cube that is rendered.  The maps between them are `boundary`, and `mixed` where parameters are
integers, choices or periodic.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fide_plugins.options import Options
from fide_plugins.population import Candidate, mirrored_pair, search_columns
from fide_plugins.runtime.schema import Schema, anything, array, check, whole
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.mixed import AxisLayout, Mixed
from fide_plugins.search.moves.base import Start
from fide_plugins.search.termination import (
    Termination,
    default_loss_only_patience,
    default_patience,
)
from fide_plugins.search.validity import Validity
from fide_plugins.types import Float64

__all__ = ["Search", "Setting"]

_MOST = 2**26  # candidates of a generation: the largest population, doubled as often as it can be
_SCHEMA: Schema = {
    "popsize": whole(2, _MOST),
    "distribution": anything,  # which checks its own
    "mixed": {"A": array("axes", low=1e-30, high=1e30)},
    "history": array("h", high=np.inf),
}


@dataclass(frozen=True)
class Setting:
    """What all searches of a run have in common.

    popsize: k; a start may multiply it.
    sigma0: (d,), standard deviation of the first search.
    options: `guard_search`, `patience`, `improvement`.
    layout: what is discrete or periodic in the cube; None: nothing.
    validity: which points may be rendered; None: all.
    """

    popsize: int
    sigma0: Float64
    options: Options
    layout: AxisLayout | None = None
    validity: Validity | None = None

    def valid_start(self, start: Start, number: int) -> Start:
        """Where search `number` begins, at a valid point."""
        if self.validity is None:
            return start
        return replace(start, mean=self.validity.start(start.mean, number))


class Search:
    """A search distribution, refined until it stalls, collapses, or has no hope.

    start: where it begins.  goal: loss that it has to beat; +inf for none.
    """

    def __init__(self, start: Start, goal: float, setting: Setting) -> None:
        self.setting = setting
        self.popsize = start.population * setting.popsize
        self._guard = setting.options.guard_search
        self._mixed = Mixed(setting.layout)
        self._start = start
        std = self._mixed.widened(start.std) if _is_first(start, setting) else start.std
        widest = start.widest if self._guard else np.inf
        self.distribution = CMAES(start.mean, std, self.popsize, widest=widest)
        dim, options = len(start.mean), setting.options
        patience = options.patience or default_patience(dim, self.popsize)
        self.termination = Termination(
            sigma0=setting.sigma0,
            patience=start.patience * patience,
            improvement=options.improvement,
            goal=goal,
            loss_only_patience=default_loss_only_patience(dim, self.popsize),
            brisk_above=np.inf if start.brisk_above is None else start.brisk_above,
            to_the_end=start.to_the_end,
        )

    @property
    def mean(self) -> Float64:
        """Mean (d,) of the distribution."""
        return self.distribution.mean

    @property
    def std(self) -> Float64:
        """Standard deviations (d,) of what is rendered."""
        return self._mixed.stretch * self.distribution.std

    def sample(self, n: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
        """Draw n candidates z ~ N(m, Sigma), and the points x that they stand for, (n, d) each."""
        validity = self.setting.validity
        if validity is None:
            return self._sample(n, rng)
        x, z, invalid = validity.sample(lambda m: self._sample(m, rng), n)
        if invalid.any():
            x = validity.at_nearest(x, invalid, self._start.mean)
            z[invalid] = self.distribution.shortened(self.closest(x[invalid]))
        return x, z

    def _sample(self, n: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
        z = self.distribution.sample(n, rng)
        return self._held(self._mixed.into(z, self.mean)), z

    def render_mean(self, mean: Float64) -> Float64:
        """Point (d,) of the cube that a mean (d,) stands for."""
        x: Float64 = self._mixed.reflected(mean[None])[0]
        return x

    def stretched(self, z: Float64) -> Float64:
        """Candidates z (n, d) as samples of N(mean, std^2), before any are put into the cube."""
        return self._mixed.stretched(z, self.mean)

    def clipped(self, x: Float64) -> Float64:
        """Points of the cube for any (n, d), clipped at its walls, or wrapped."""
        return self._mixed.clipped(x)

    def place_proposals(self, x: Float64, z: Float64) -> Float64:
        """Points of the cube for proposals x (n, d), with the values that this search holds.

        z: (n, d), samples of which they were made.
        """
        x, validity = self._held(self.clipped(x)), self.setting.validity
        if validity is None:
            return x
        sampled = self._held(self._mixed.into(z, self.mean))
        return validity.moved_back(x, sampled, self._start.mean)

    def _held(self, x: Float64) -> Float64:
        """Points (n, d) with the coordinates of the start on the axes that are held."""
        held = self._start.held
        return x if held is None else np.where(held, self._start.mean, x)

    def closest(self, x: Float64) -> Float64:
        """Return the z (n, d) of points x (n, d) that is closest to the mean."""
        return self._mixed.closest(x, self.mean)

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
        pair = mirrored_pair(members)
        if pair is not None and injected[list(pair)].any():
            pair = None
        self.distribution.tell(z, losses, injected & self._guard, pair)
        self._correct()

    def preview(self, members: list[Candidate], losses: Float64) -> Search:
        """Return what `tell` would make of the search now, with a part of a generation."""
        z, injected = search_columns(members)
        other = copy.copy(self)
        other._mixed = copy.copy(self._mixed)
        other.distribution = self.distribution.preview(z, losses, injected & self._guard)
        other._correct()
        return other

    def _correct(self) -> None:
        """Apply the margin, and move the mean back to what is held."""
        self._mixed.correct(self.distribution)
        self.distribution.mean = self._held(self.distribution.mean)

    def is_over(self, *, guided: bool) -> bool:
        """Whether to look elsewhere; guided: whether images guide the search."""
        return self.termination.is_over(self.distribution.std, guided=guided)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes, and the population size."""
        return {
            "popsize": self.popsize,
            "distribution": self.distribution.state_dict(),
            "mixed": self._mixed.state_dict(),
            "history": np.array(self.termination.history, np.float64),
        }

    @classmethod
    def from_state(
        cls, state: Mapping[str, Any], start: Start, goal: float, setting: Setting
    ) -> Search:
        """Search that goes on where `state_dict` was called; ValueError if it is none."""
        check(state, _SCHEMA, {}, "search")
        search = cls(start, goal, setting)
        k, axes = search.popsize, len(search._mixed.A)
        if (state["popsize"], len(state["mixed"]["A"])) != (k, axes):
            raise ValueError(f"a search of {state['popsize']} candidates, not {k}, or other axes")
        search.distribution = CMAES.from_state(state["distribution"], len(start.mean), k)
        search._mixed.load_state_dict(state["mixed"])
        search.termination.history = state["history"].tolist()
        return search


def _is_first(start: Start, setting: Setting) -> bool:
    """Whether the search begins as wide as the first one, since nothing is known."""
    return bool(np.array_equal(start.std, setting.sigma0))
