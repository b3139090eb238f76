"""A linear model of the features around one solution, and how well the samples tell it.

Notation: u [n, d], parameters minus those of the solution; e [n, f], features; D [n], squared
distance of the features from those of the solution; J [d, f], e ~ a + (u - m) J.

J is fitted by weighted least squares.  The error of a sample is noise and curvature; curvature
grows with the distance of the images, so its variance is taken for v = s + rho D, and its weight is
1 / v.  Both s and rho come from the residuals, each divided by one minus its leverage.

Samples of one search lie together, and share what a linear model misses there.  As independent
errors they would look like knowledge.  So the error of J is found by leaving out groups of
consecutive samples of equal weight (the delete-a-group jackknife, Kott 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fide_plugins.types import Float64

__all__ = ["FitToTarget", "LocalFit", "energy_of", "fit_from_afar", "fit_locally"]

_ROUNDS = 3  # of weights
_RIDGE = 1e-4  # of each parameter's own sum of squares
_NEAR = 3  # times d samples, which say what s is
_FEWEST_NEAR = 30
_LOWEST = 0.1  # of one minus a leverage
_RHO = (1e-4, 1.0)
_GROUPS = 20
_STILL = 1e-30  # spread of a parameter that never moved: the digits of its numbers are coarser
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class LocalFit:
    """What `fit_locally` found.

    J: (d, f).  center: (d,), m.  features: (f,), a.
    normal: (d, d), (u - m)^T W (u - m).  cloud: (d, d), weighted second moment of u.
    changes: (g, d, f), of J by leaving out one group each, scaled so that the sum of their products
        is the energy of its error.
    s, rho, reach: a sample whose features are farther than `reach` misses by s + rho (D - reach).
    """

    J: Float64
    center: Float64
    features: Float64
    normal: Float64
    cloud: Float64
    changes: Float64
    s: float
    rho: float
    reach: float

    def misses(self, u: Float64) -> Float64:
        """Squared errors (n,) that are to be expected of the model at samples u (n, d)."""
        beyond = np.maximum(np.square(u @ self.J).sum(axis=1) - self.reach, 0.0)
        expected: Float64 = self.s + self.rho * beyond
        return expected

    @cached_property
    def error(self) -> Float64:
        """Energy (d, d) of the error of J: the sum over the features of its covariances."""
        return energy_of(self.changes)

    @property
    def here(self) -> Float64:
        """Features (f,) that the model predicts for the solution itself."""
        predicted: Float64 = self.features - self.center @ self.J
        return predicted


class FitToTarget(NamedTuple):
    """The linear model of a solution, beside the target of which the solution was sought.

    fit: the model.
    target: (f',), its features.
    f: how many of them are independent; f' is less where they are turned into fewer.
    farthest: squared, by how much features of the run differ from the solution's at most.
    from_afar: models of samples that are less alike.
    as_far: (d,), how far away the truth may be where the model says nothing; None: in the cube.
    """

    fit: LocalFit
    target: Float64
    f: int
    farthest: float = 0.0
    from_afar: tuple[LocalFit, ...] = ()
    as_far: Float64 | None = None

    @property
    def residual(self) -> Float64:
        """(f',), features of the target that those of the solution lack."""
        missing: Float64 = self.target - self.fit.here
        return missing


def fit_locally(u: Float64, e: Float64, distances: Float64) -> LocalFit:
    """Fit features e (n, f) of samples u (n, d), in the order of asking; n > d + 1.

    distances: (n,), squared, of their features from those of the solution.
    """
    order = np.argsort(distances, kind="stable")
    near, far = order[: max(_NEAR * u.shape[1], _FEWEST_NEAR)], order[len(order) // 3 :]
    reach = max(float(np.median(distances[near])), _TINY)
    beyond = np.maximum(distances - reach, 0.0)
    weights = 1 / (reach + beyond)
    for _ in range(_ROUNDS):
        found = _regress(u, e, weights)
        missed = found.missed()
        s = max(float(np.median(missed[near])), 1e-9 * reach)
        slopes = np.maximum(missed - s, 0.0)[far] / (beyond[far] + 1e-9 * reach)
        rho = float(np.clip(np.median(slopes), *_RHO))
        weights = 1 / (s + rho * beyond)
    return _local(u, found, s, rho, reach)


def energy_of(changes: Float64) -> Float64:
    """Energy (d, d) of an error with these changes (g, d, f), see `LocalFit`."""
    energy: Float64 = np.tensordot(changes, changes, ((0, 2), (0, 2)))
    return energy


def fit_from_afar(u: Float64, e: Float64, distances: Float64, s: float) -> LocalFit:
    """As `fit_locally`, but samples of which the squared distance is below s > 0 count alike."""
    return _local(u, _regress(u, e, 1 / np.maximum(distances, s)), s, 1.0, s)


def _local(u: Float64, found: _Regression, s: float, rho: float, reach: float) -> LocalFit:
    """The model of samples u (n, d), in units of the parameters."""
    spread = found.spread
    J, changes = found.J / spread[:, None], _jackknife(found) / spread[:, None]
    cloud = (u * found.shares[:, None]).T @ u
    normal = found.normal * np.outer(spread, spread)
    return LocalFit(J, found.center, found.origin, normal, cloud, changes, s, rho, reach)


class _Regression(NamedTuple):
    """Weighted least squares.

    center, origin: (d,), (f,), weighted means of u and e.
    spread: (d,), weighted standard deviations of u, in units of which all that follows is: a search
        may know one parameter to 1e-9 and another not at all.  1 for parameters that never moved.
    J: (d, f).  u, e: (n, d), (n, f), without their means.  weighted: (n, d), u times its weights.
    normal: (d, d), u^T W u, with a ridge.
    shares: (n,), weights that sum to 1.  leverages: (n,), without these.
    """

    center: Float64
    origin: Float64
    spread: Float64
    J: Float64
    u: Float64
    e: Float64
    weighted: Float64
    normal: Float64
    shares: Float64
    leverages: Float64

    def missed(self) -> Float64:
        """Squared errors (n,) of the samples, as if each were not in the model."""
        left = 1 - self.leverages - self.shares
        missed: Float64 = np.square(self.e - self.u @ self.J).sum(axis=1)
        return missed / np.maximum(left, _LOWEST)


def _regress(u: Float64, e: Float64, weights: Float64) -> _Regression:
    """Fit features e (n, f) of samples u (n, d) with weights (n,)."""
    shares = weights / weights.sum()
    center, origin = shares @ u, shares @ e
    u, e = u - center, e - origin
    spread = np.sqrt(shares @ np.square(u))
    still = spread < _STILL
    u, spread = np.where(still, 0.0, u), np.where(still, 1.0, spread)
    u = u / spread
    weighted = u * weights[:, None]
    normal = _ridged(weighted.T @ u)
    P = np.linalg.solve(normal, weighted.T)  # (d, n)
    leverages = np.einsum("nd,dn->n", u, P)
    return _Regression(center, origin, spread, P @ e, u, e, weighted, normal, shares, leverages)


def _jackknife(found: _Regression) -> Float64:
    """Changes (g, d, f) of J by leaving out groups of consecutive samples, see `LocalFit`."""
    J, u, e, weighted, normal = found.J, found.u, found.e, found.weighted, found.normal
    number = min(_GROUPS, len(u) // 2)
    groups = np.minimum((np.cumsum(found.shares) * number).astype(np.intp), number - 1)
    products = weighted.T @ e
    changes = []
    for out in (groups == group for group in np.unique(groups)):
        rest = normal - weighted[out].T @ u[out]
        rest += 1e-9 * float(np.trace(normal)) / len(rest) * np.eye(len(rest))
        changes.append(np.linalg.solve(rest, products - weighted[out].T @ e[out]) - J)
    scaled: Float64 = np.array(changes) * ((number - 1) / number) ** 0.5
    return scaled


def _ridged(normal: Float64) -> Float64:
    """Normal equations (d, d) that can be solved: also of parameters that never moved."""
    diagonal = np.diag(normal)
    ridged: Float64 = normal + np.diag(np.where(diagonal > 0, _RIDGE * diagonal, 1.0))
    return ridged
