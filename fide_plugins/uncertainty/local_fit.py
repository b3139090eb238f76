"""A linear model of the features around one solution, and the covariance that follows from it.

u (n, d): parameters minus the solution's; e (n, f): features ~ a + (u - m) J; D (n,): |e - e0|^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from fide_plugins.types import Float64, Mask

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
    def at_solution(self) -> Float64:
        """Features (f,) that the model predicts for the solution itself."""
        predicted: Float64 = self.features - self.center @ self.J
        return predicted


class FitToTarget(NamedTuple):
    """The linear model of a solution, beside the target (f',) of which it was sought.

    f: how many features are independent; f' is less where they are turned into fewer.
    farthest: squared, by how much features of the run differ from the solution's at most.
    as_far: (d,), how far away the truth may be where the model says nothing; None: in the cube.
    """

    fit: LocalFit
    target: Float64
    f: int
    farthest: float = 0.0
    as_far: Float64 | None = None

    @property
    def residual(self) -> Float64:
        """(f',), features of the target that those of the solution lack."""
        missing: Float64 = self.target - self.fit.at_solution
        return missing


def fit_locally(u: Float64, e: Float64, distances: Float64) -> LocalFit:
    """Fit features e (n, f) of samples u (n, d), in the order of asking; n > d + 1.

    By least squares with weights 1 / (s + rho D), the variances of noise and curvature, which come
    from the residuals; the error of J by the delete-a-group jackknife (Kott 2001).

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
    spread = found.spread
    J, changes = found.J / spread[:, None], _jackknife(found) / spread[:, None]
    cloud = (u * found.shares[:, None]).T @ u
    normal = found.normal * np.outer(spread, spread)
    return LocalFit(J, found.center, found.origin, normal, cloud, changes, s, rho, reach)


def energy_of(changes: Float64) -> Float64:
    """Energy (d, d) of an error with these changes (g, d, f), see `LocalFit`."""
    energy: Float64 = np.tensordot(changes, changes, ((0, 2), (0, 2)))
    return energy


class _Regression(NamedTuple):
    """Weighted least squares."""

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
    normal = weighted.T @ u
    diagonal = np.diag(normal)  # solvable, also with parameters that never moved
    normal = normal + np.diag(np.where(diagonal > 0, _RIDGE * diagonal, 1.0))
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


_RESOLVED = 1.1  # times its error, from which on J J^T is more than that
_CHANCE = 0.99  # quantile of the ratio up to which it may be chance
_SMALL = 1e-9  # of the mean energy of J, which is the least error
_ROUNDING_OF_ERROR = 1e-13  # of the energy of an error: its last digits
_FEWER = 1e-6  # one over the most independent features that are counted
_TINIEST = float(np.finfo(np.float64).tiny)


class _Directions(NamedTuple):
    """Directions w_i with w_i^T E w_j = (i = j) and w_i^T J J^T w_i = ratio_i."""

    steps: Float64
    slopes: Float64
    ratios: Float64
    chance: Mask


def unseen(fit: LocalFit, most: float, rounding: float) -> Float64:
    """Orthonormal directions (d, m), m >= 0, that are unseen.

    Along them the image changes next to nothing over the cube, and the little may be chance: the
    ratio of J J^T to its error then follows an F distribution (Satterthwaite 1946).

    most: change of the features, squared, over the side of the cube, that is next to nothing.
    rounding: such a change that is only one of their last digits.
    """
    found = _directions(fit, rounding)
    basis = np.linalg.qr(found.steps[:, found.chance])[0]  # (d, k)
    changes = np.linalg.eigh(basis.T @ (fit.J @ fit.J.T + fit.error) @ basis)
    steps: Float64 = basis @ changes.eigenvectors[:, changes.eigenvalues <= most]
    return steps


def _directions(fit: LocalFit, least: float = 0.0) -> _Directions:
    """Of a model; least: added to the energy of its error in each direction."""
    normal = fit.normal
    scale = np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    values = np.maximum(values, 1e-14 * values[-1] + _TINIEST)
    root = (vectors * np.sqrt(values)) @ vectors.T * scale  # (d, d)
    back = (vectors / np.sqrt(values)) @ vectors.T / scale[:, None]
    J, changes = root @ fit.J, np.matmul(root, fit.changes)  # all directions alike
    energy = J @ J.T
    error = energy_of(changes) + least * root @ root.T
    small = _SMALL * float(np.trace(energy)) / len(energy)  # far less where J is only its error
    floor = max(small, _ROUNDING_OF_ERROR * float(np.trace(error))) + _TINIEST
    L = np.linalg.cholesky(error + floor * np.eye(len(error)))
    inner = np.linalg.solve(L, np.linalg.solve(L, energy).T)
    ratios, rotation = np.linalg.eigh((inner + inner.T) / 2)
    steps = np.linalg.solve(L.T, rotation)
    chance = ratios <= _quantiles(np.matmul(steps.T, changes))
    return _Directions(root.T @ steps, back @ L @ rotation, ratios, chance)


def _quantiles(changes: Float64) -> Float64:
    """Quantiles (m,) of the ratio by chance, of changes (g, m, f) of J in m directions."""
    products = np.einsum("gmf,hmf->mgh", changes, changes)
    own = np.einsum("mgg->mg", products)  # (m, g)
    both = np.square(own.sum(axis=1)) - np.square(own).sum(axis=1)
    others = np.square(products).sum(axis=(1, 2)) - np.square(own).sum(axis=1)
    features = np.maximum(
        both / np.maximum(others, _FEWER * both + _TINIEST), 1.0
    )  # tr(S)^2 / tr(S^2)
    quantiles: Float64 = fdtri(features, features * (len(changes) - 1), _CHANCE)
    return quantiles


_BOX = 12.0  # one over the variance of the uniform law on [0, 1]
WIDER = 5.0
NO_EFFECT = 1e-3  # of the largest change of the image in the run, squared: 3 % of it
_RIDGE_OF_J = 1e-4  # of the mean eigenvalue
_NEAREST = 1e-6  # of the cube: samples as good may be nowhere else
_SAME = 1e-8  # sine of an angle of directions that are one
_DIGITS = float(np.finfo(np.float64).eps)  # of the largest eigenvalue, for each parameter
_ROUNDING_OF_TARGET = 1e-14  # of the target's energy: its last digits, in single precision


def covariance(model: FitToTarget) -> Float64:
    """(d, d), in units of the unit cube.

    The inverse of J J^T, scaled by the noise of the target or what the search has left, with the
    uniform prior.  Along directions that are not resolved the truth is at most `WIDER` times as far
    away as samples that look alike; along those that are unseen only the prior counts.
    """
    fit, d = model.fit, len(model.fit.J)
    steps = unseen(fit, NO_EFFECT * model.farthest, _rounding(model))
    found = _directions(fit)
    resolved = found.ratios > _RESOLVED  # J J^T exceeds its error there
    energy = (found.slopes * np.where(resolved, found.ratios - 1, 0.0)) @ found.slopes.T
    rest = np.linalg.qr(found.steps[:, ~resolved])[0]
    known = energy / scale_of(model) + _reach(fit.cloud, rest)
    along = np.eye(d) - steps @ steps.T
    precision = along @ known @ along + _BOX * np.eye(d)
    if model.as_far is not None:
        # how far away the truth may be counts in the span of both
        vectors, sizes, _ = np.linalg.svd(np.hstack([steps, rest]), full_matrices=False)
        projector = vectors[:, sizes > _SAME] @ vectors[:, sizes > _SAME].T
        precision += (projector / np.maximum(model.as_far, _NEAREST) ** 2) @ projector
    return _inverse(precision)


def _inverse(precision: Float64) -> Float64:
    """Inverse (d, d), positive also where the last digits of its largest directions hide others."""
    scale = np.sqrt(np.maximum(np.diag(precision), _BOX))
    values, vectors = np.linalg.eigh(precision / np.outer(scale, scale))
    vectors = vectors / scale[:, None]
    hidden = values < len(values) * _DIGITS * values[-1]
    shown, open_ = vectors[:, ~hidden], vectors[:, hidden]
    inverse: Float64 = (shown / values[~hidden]) @ shown.T
    if hidden.any():
        inverse += open_ @ np.linalg.pinv(_BOX * open_.T @ open_, hermitian=True) @ open_.T
    return inverse


def _reach(cloud: Float64, steps: Float64) -> Float64:
    """Precision (d, d) along `steps` (d, k), by how far samples that look alike reach there."""
    d = len(cloud)
    wider = WIDER**2 * cloud
    wider += 1e-12 * (1 + float(np.trace(wider)) / d) * np.eye(d)
    precision: Float64 = steps @ np.linalg.solve(steps.T @ wider @ steps, steps.T)
    return precision


def scale_of(model: FitToTarget) -> float:
    """Variance of a feature that the truth is away."""
    noise, residual = noise_of(model), model.residual
    explained = float(residual @ residual) - noise * model.f
    return max(noise, explained / len(model.fit.J), _rounding(model) / model.f)


def noise_of(model: FitToTarget) -> float:
    """Variance of a feature that the parameters cannot explain, sigma^2."""
    left = unexplained(model.fit, model.residual)
    return float(left @ left) / model.f


def _rounding(model: FitToTarget) -> float:
    """Energy of the last digits of the features."""
    return _ROUNDING_OF_TARGET * float(model.target @ model.target) + float(
        np.finfo(np.float64).tiny
    )


def unexplained(fit: LocalFit, residual: Float64) -> Float64:
    """What the parameters cannot explain of a residual (f,)."""
    d = len(fit.J)
    energy = fit.J @ fit.J.T
    ridge = _RIDGE_OF_J * float(np.trace(energy)) / d + np.finfo(np.float64).tiny
    left: Float64 = residual - np.linalg.solve(energy + ridge * np.eye(d), fit.J @ residual) @ fit.J
    return left
