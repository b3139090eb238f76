"""The standard deviations of one solution, by the samples that were known when it was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.distance import cdist
from torch import Tensor

from fide_plugins.population import TrainingSample
from fide_plugins.runtime.threads import one_thread
from fide_plugins.search.mixed import Axes
from fide_plugins.types import OPEN, Estimated, Float64, Indices, Mask
from fide_plugins.uncertainty.local_fit import (
    NO_EFFECT,
    WIDER,
    FitToTarget,
    deviations,
    fit_locally,
    noise_of,
)
from fide_plugins.uncertainty.samples import (
    Surroundings,
    compressed,
    features_of,
    floored,
    independent,
    most_alike,
    surroundings,
)

# -- samples as good -------------------------------------------------------------------------------


_ODDS = 4.0  # twice the logarithm of the likelihood ratio up to which both may be true
_LUCK = 4.0  # standard deviations of what noise of the renders changes; the best had luck
_ROUNDING = (1 / 255) ** 2 / 12  # mean squared error of 8 bits
_MOST = 600  # samples that are compared with each other
_SAME = 1e-9  # of the largest change of the image: neither is better


def limits(around: Surroundings, missed: Float64, model: FitToTarget, std: Float64) -> Float64:
    """How far (p,) the truth may be in each number that is open; infinite where nothing limits it.

    What the model leaves open is open only where samples speak for it: an image as good lies far
    away in that number, or the number has no effect.  Else samples as good limit it.

    missed: (n,), squared, by how much samples miss the target.  std: (p,), by the model alone.
    """
    more = max(NO_EFFECT * model.farthest, _as_good(model))
    good = around.own[missed[around.own] <= missed[around.at] + more]
    far = np.abs(around.steps(good)).max(axis=0)
    limited = np.full(len(std), np.inf)
    for one in np.flatnonzero((std >= OPEN) & (far < OPEN)):
        if not _without_effect(around, int(one)):
            limited[one] = WIDER * far[one]
    return limited


def _as_good(model: FitToTarget) -> float:
    """By how much more, squared, a sample may miss the target and be as good a solution."""
    noise = noise_of(model)
    # by how much the noise of a render changes what it misses: a standard deviation, squared errors
    luck = _LUCK * (2 * model.fit.s * (model.fit.s / model.f + 2 * noise)) ** 0.5
    return float(_ODDS * noise + luck)


def _without_effect(around: Surroundings, one: int) -> bool:
    """Whether nearest neighbors in all other numbers have the better image more often than in all.

    A search leaves a number without effect where it is.
    """
    rows = around.own[:: -(-len(around.own) // _MOST)]
    u, e = around.steps(rows), around.features[rows]
    others = np.arange(u.shape[1]) != one
    apart = _apart(u, others, around.periodic)
    np.fill_diagonal(apart, np.inf)
    with_it, without = (
        np.square(e - e[gaps.argmin(axis=1)]).sum(axis=1)
        for gaps in (apart + _apart(u, ~others, around.periodic), apart)
    )
    same = _SAME * float(around.distances[around.own].max())
    worse, better = (without > with_it + same).sum(), (without < with_it - same).sum()
    return bool(worse <= better)


def _apart(u: Float64, which: Mask, periodic: Mask | None) -> Float64:
    """Squared distances (n, n) of samples u (n, p) in some numbers (p,), the shorter way around."""
    around = np.zeros(len(which), bool) if periodic is None else periodic
    apart: Float64 = cdist(u[:, which & ~around], u[:, which & ~around], "sqeuclidean")
    for angle in u.T[which & around]:
        gaps = np.abs(angle[:, None] - angle)
        apart += np.square(np.minimum(gaps, 1.0 - gaps))
    return apart


# -- the estimate ----------------------------------------------------------------------------------


@dataclass(eq=False)
class LocalEstimate:
    """How sure the parameters of a solution are, computed when it is first read.

    x: (d,), the solution.
    samples: evaluated candidates, some perhaps twice; empty once `std` was read.
    target: (T, C), tokens; channels: so many leading ones count; None: all.
    axes, discrete, blocks: periodic axes; (d,), those of integers and choices; (n, L), exchangeable
        ones; None: there are none.
    """

    x: Float64
    samples: Sequence[TrainingSample]
    target: Tensor
    channels: int | None
    axes: Axes
    discrete: Mask | None = None
    blocks: Indices | None = None
    _found: Estimated | None = field(default=None, init=False, repr=False)

    @property
    def std(self) -> Float64 | None:
        """(d,), NaN for integers and choices; None where too few samples are known."""
        return self._estimated.std

    @property
    def rough(self) -> bool:
        """True: another path of the search has other samples."""
        return True

    @property
    def ambiguous(self) -> Mask | None:
        """(d,), integers and choices of which another value may be the true one."""
        return self._estimated.ambiguous

    @property
    def _estimated(self) -> Estimated:
        samples = self.samples  # before the question: another thread empties them after its answer
        if self._found is None:
            with np.errstate(under="ignore"):  # of a user who lets it raise; here it is 0
                self._found = self._compute(samples)
            self.samples = ()
        return self._found

    @one_thread
    def _compute(self, samples: Sequence[TrainingSample]) -> Estimated:
        std, ambiguous = np.full(len(self.x), np.nan), np.zeros(len(self.x), bool)
        around = surroundings(self.x, samples, self.channels, self.axes, self.discrete, self.blocks)
        if around is None:
            return Estimated(None, ambiguous)
        target = features_of([self.target], self.channels)[0]
        missed = np.square(around.features - target).sum(axis=1)
        near = most_alike(around, float(missed[around.at]))  # 1
        model = self._fit(around, target, near)  # 2
        as_far = limits(around, missed, model, deviations(model))  # 3
        std[around.free] = deviations(model._replace(as_far=as_far))
        # another value of which an image is as good to 8 bits, or within the noise of the target
        least = _ROUNDING * around.features.shape[1]
        good = missed <= max(missed[around.at] + _as_good(model), least)
        differs = np.flatnonzero(around.other[around.matched & good].any(axis=0))
        ambiguous |= np.isin(np.arange(len(self.x)), self.axes.together(differs))
        return Estimated(std, ambiguous)

    def _fit(self, around: Surroundings, target: Float64, near: Indices) -> FitToTarget:
        """The linear model of the samples `near` (m,)."""
        f = independent(target, len(self.target), around.features)
        e, target = compressed(around.features[near], target)
        fit = fit_locally(around.steps(near), e, floored(around.distances[near]))
        farthest = float(around.distances[around.own].max())
        return FitToTarget(fit, target, f, farthest)
