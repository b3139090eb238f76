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

from fide_plugins.types import Float64, Indices
from fide_plugins.uncertainty.covariance import scale_of, unexplained
from fide_plugins.uncertainty.local_fit import LocalFit

__all__ = ["FEWEST", "Pairs", "looks_alike"]

FEWEST = 5  # samples with the other value; fewer say nothing of it
_ODDS = 4.0  # twice the logarithm of the likelihood ratio up to which both may be true
_NEAR = 20.0  # times as much as near the solution may be missed; samples beyond say nothing
_SMALL = 1e-3  # of the energy of the target, and with it 3 % of its features
_SPREAD = 1.0  # standard deviations of the difference, by the error of delta


class Pairs(NamedTuple):
    """Samples with another value, and one of the solution's own value for each.

    u, own_u: (n, d), steps from the solution.  e, own_e: (n, f), features.
    own: (n,), numbers of the latter, of which some may be there several times.
    """

    u: Float64
    e: Float64
    own_u: Float64
    own_e: Float64
    own: Indices


def looks_alike(fit: LocalFit, target: Float64, f: int, pairs: Pairs) -> bool:
    """Whether the other value may be the true one.

    target: (f',), its features; f: how many there are, where they are turned into fewer.
    """
    missing = fit.misses(pairs.u) + fit.misses(pairs.own_u)
    near = missing <= 2 * max(_NEAR * fit.s, _SMALL * float(target @ target))
    if near.sum() < FEWEST:
        return False
    weights = np.where(near, 1 / missing, 0.0)
    weights = weights / weights.sum()
    changes = pairs.e - pairs.own_e - (pairs.u - pairs.own_u) @ fit.J  # (n, f')
    delta = weights @ changes
    missed = float(weights @ np.square(changes - delta).sum(axis=1)) / 2  # by one of the two
    of_own = np.bincount(np.unique(pairs.own, return_inverse=True)[1], weights)
    error = missed * float(weights @ weights + of_own @ of_own)  # energy, over all features
    residual = target - fit.here
    own, other = (unexplained(fit, one) for one in (residual, residual - delta))
    spread = error * (2 / f) ** 0.5 + 2 * float(np.linalg.norm(own)) * (error / f) ** 0.5
    more = float(other @ other) - error - float(own @ own)
    alike: bool = more <= _ODDS * scale_of(fit, target, f) + _SPREAD * spread
    return alike
