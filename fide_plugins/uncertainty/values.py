"""Whether the picture tells one value of an integer or a choice from another.

Each sample with the other value is compared with one of the solution's own value that was asked at
the same time, so of the same distribution: both miss the linear model there, by curvature and by
noise, and the mean of the differences, delta, is what the value changes in the features.  A value
that changes what the picture shows leaves more of the target unexplained, whatever the other
parameters are:

    |left(target - here - delta)|^2 - |left(target - here)|^2,   left: what J cannot explain

Delta has an error, by which the first term is too large.  The value may be the true one if the
difference is below `_ODDS` times the variance of a feature (`covariance`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fide_plugins.search.scene import Axes
from fide_plugins.types import Float64, Indices
from fide_plugins.uncertainty.covariance import scale_of, unexplained
from fide_plugins.uncertainty.local_fit import FitToTarget
from fide_plugins.uncertainty.selection import Surroundings

__all__ = ["OtherValue", "Pairs", "looks_alike", "other_values"]

_FEWEST = 5  # samples with the other value; fewer say nothing of it
_ODDS = 4.0  # twice the logarithm of the likelihood ratio up to which both may be true
_NEAR = 20.0  # times as much as near the solution may be missed; samples beyond say nothing
_SMALL = 1e-3  # of the energy of the target, and with it 3 % of its features
_SPREAD = 1.0  # standard deviations of the difference, by the error of delta


class OtherValue(NamedTuple):
    """Another value of an integer or a choice, which was rendered.

    axes: (a,), of that parameter.
    rows: (n,), samples with this value, and with the solution's own values of all others.
    own: (n,), for each the sample with the own value that was asked at the nearest time; some of
        these may be there several times.
    """

    axes: Indices
    rows: Indices
    own: Indices


class Pairs(NamedTuple):
    """What is known of the samples of an `OtherValue`.

    u, own_u: (n, p), steps from the solution.  e, own_e: (n, f'), features.
    own: (n,), rows of the own ones.
    """

    u: Float64
    e: Float64
    own_u: Float64
    own_e: Float64
    own: Indices


def other_values(around: Surroundings, axes: Axes) -> list[OtherValue]:
    """Those that enough samples have."""
    found = []
    for one in (one for one in axes.axes_of if around.other[:, one].any()):
        elsewhere = np.ones(around.other.shape[1], bool)
        elsewhere[one] = False
        here, there = around.other[:, one].any(axis=1), around.other[:, elsewhere].any(axis=1)
        just_here = np.flatnonzero(around.matched & here & ~there)
        values = np.round(around.points[just_here][:, one], 6)
        for value in np.unique(values, axis=0):
            rows = just_here[(values == value).all(axis=1)]
            if len(rows) >= _FEWEST:
                found.append(OtherValue(one, rows, _nearest(around.own, rows)))
    return found


def _nearest(own: Indices, rows: Indices) -> Indices:
    """Of the samples `own`, in the order of asking, that nearest in time to each of `rows`."""
    after = np.clip(np.searchsorted(own, rows), 1, len(own) - 1)
    before = after - 1
    return np.where(rows - own[before] <= own[after] - rows, own[before], own[after])


def looks_alike(model: FitToTarget, pairs: Pairs) -> bool:
    """Whether the other value may be the true one."""
    fit, target, f = model.fit, model.target, model.f
    missing = fit.misses(pairs.u) + fit.misses(pairs.own_u)
    near = missing <= 2 * max(_NEAR * fit.s, _SMALL * float(target @ target))
    if near.sum() < _FEWEST:
        return False
    weights = np.where(near, 1 / missing, 0.0)
    weights = weights / weights.sum()
    changes = pairs.e - pairs.own_e - (pairs.u - pairs.own_u) @ fit.J  # (n, f')
    delta = weights @ changes
    missed = float(weights @ np.square(changes - delta).sum(axis=1)) / 2  # by one of the two
    of_own = np.bincount(np.unique(pairs.own, return_inverse=True)[1], weights)
    error = missed * float(weights @ weights + of_own @ of_own)  # energy, over all features
    own, other = (unexplained(fit, r) for r in (model.residual, model.residual - delta))
    spread = error * (2 / f) ** 0.5 + 2 * float(np.linalg.norm(own)) * (error / f) ** 0.5
    more = float(other @ other) - error - float(own @ own)
    alike: bool = more <= _ODDS * scale_of(model) + _SPREAD * spread
    return alike
