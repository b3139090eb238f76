"""Which samples explain the target as well as the solution, and how far away these are.

A linear model says nothing of an image that changes in jumps.  So what it leaves open counts as
open only where samples speak for it:

1. A sample whose image is *as good* lies far away in that number.  As good is what misses the
   target by no more than the solution does, within noise, or within what is next to nothing.
2. A search of steps leaves a number without effect where it is, so there may be no such sample.
   Then the nearest neighbor of each sample is compared with the nearest one in all other numbers.
   Without effect, the second has the better image more often; of what shows, the first.

Otherwise the truth is taken to be at most `WIDER` times as far away as samples as good.  Of an
integer or a choice, one such sample with another value says that the picture does not tell them
apart.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from fide_plugins.types import OPEN, Float64, Mask
from fide_plugins.uncertainty.covariance import NO_EFFECT, WIDER, noise_of
from fide_plugins.uncertainty.local_fit import FitToTarget
from fide_plugins.uncertainty.selection import Surroundings

__all__ = ["explain_as_well", "limits", "misses_of"]

_ODDS = 4.0  # twice the logarithm of the likelihood ratio up to which both may be true
_SPREAD = 4.0  # standard deviations of what noise of the renders changes; the best had luck
_ROUNDING = (1 / 255) ** 2 / 12  # mean squared error of 8 bits
_MOST = 600  # samples that are compared with each other
_SAME = 1e-9  # of the largest change of the image: neither is better


def misses_of(around: Surroundings, target: Float64) -> Float64:
    """(n,), squared, by how much features (n, f) of samples miss the target (f,)."""
    missed: Float64 = np.square(around.features - target).sum(axis=1)
    return missed


def explain_as_well(around: Surroundings, missed: Float64, model: FitToTarget) -> Mask:
    """(n,), samples with an image as good to 8 bits, or within the noise of the target.

    missed: (n,), of `misses_of`.
    """
    rounding = _ROUNDING * around.features.shape[1]
    good: Mask = missed <= max(missed[around.at] + _ODDS * noise_of(model), rounding)
    return good


def limits(around: Surroundings, missed: Float64, model: FitToTarget, std: Float64) -> Float64:
    """How far (p,) the truth may be in each number that is open; infinite where nothing limits it.

    missed: (n,), of `misses_of`.  std: (p,), by the model alone.
    """
    noise = noise_of(model)
    # by how much the noise of a render changes what it misses: a standard deviation, squared errors
    luck = _SPREAD * (2 * model.fit.s * (model.fit.s / model.f + 2 * noise)) ** 0.5
    more = max(NO_EFFECT * model.farthest, _ODDS * noise + luck)
    good = around.own[missed[around.own] <= missed[around.at] + more]
    far = np.abs(around.steps(good)).max(axis=0)
    limited = np.full(len(std), np.inf)
    for one in np.flatnonzero((std >= OPEN) & (far < OPEN)):
        if not _without_effect(around, int(one)):
            limited[one] = WIDER * far[one]
    return limited


def _without_effect(around: Surroundings, one: int) -> bool:
    """Whether the neighbors in all other numbers have the better images more often."""
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
