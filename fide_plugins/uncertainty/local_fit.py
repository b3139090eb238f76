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

import numpy as np

from fide_plugins.types import Float64

__all__ = ["LocalFit", "fit_locally"]

_ROUNDS = 3  # of weights
_RIDGE = 1e-4  # of each parameter's own sum of squares
_NEAR = 3  # times d samples, which say what s is
_FEWEST_NEAR = 30
_LOWEST = 0.1  # of one minus a leverage
_RHO = (1e-4, 1.0)
_GROUPS = 20
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class LocalFit:
    """What `fit_locally` found.

    J: (d, f).  center: (d,), m.  features: (f,), a.
    normal: (d, d), (u - m)^T W (u - m).  cloud: (d, d), weighted second moment of u.
    error: (d, d), energy of the error of J: the sum over the features of its covariances.
    s, rho, reach: a sample whose features are farther than `reach` misses by s + rho (D - reach).
    """

    J: Float64
    center: Float64
    features: Float64
    normal: Float64
    cloud: Float64
    error: Float64
    s: float
    rho: float
    reach: float

    def misses(self, u: Float64) -> Float64:
        """Squared errors (n,) that are to be expected of the model at samples u (n, d)."""
        beyond = np.maximum(np.square(u @ self.J).sum(axis=1) - self.reach, 0.0)
        expected: Float64 = self.s + self.rho * beyond
        return expected

    @property
    def here(self) -> Float64:
        """Features (f,) that the model predicts for the solution itself."""
        predicted: Float64 = self.features - self.center @ self.J
        return predicted


def fit_locally(u: Float64, e: Float64, distances: Float64) -> LocalFit:
    """Fit features e (n, f) of samples u (n, d), in the order of asking; n > d + 1.

    distances: (n,), squared, of their features from those of the solution.
    """
    d = u.shape[1]
    order = np.argsort(distances, kind="stable")
    near, far = order[: max(_NEAR * d, _FEWEST_NEAR)], order[len(order) // 3 :]
    reach = max(float(np.median(distances[near])), _TINY)
    beyond = np.maximum(distances - reach, 0.0)
    weights = 1 / (reach + beyond)
    for _ in range(_ROUNDS):
        shares = weights / weights.sum()
        center, origin = shares @ u, shares @ e
        uc, ec = u - center, e - origin
        weighted = uc * weights[:, None]
        normal = _ridged(weighted.T @ uc)
        P = np.linalg.solve(normal, weighted.T)  # (d, n)
        J = P @ ec
        left = 1 - np.einsum("nd,dn->n", uc, P) - shares
        missed = np.square(ec - uc @ J).sum(axis=1) / np.maximum(left, _LOWEST)
        s = max(float(np.median(missed[near])), 1e-9 * reach)
        rho = np.median(np.maximum(missed - s, 0.0)[far] / (beyond[far] + 1e-9 * reach))
        rho = float(np.clip(rho, *_RHO))
        weights = 1 / (s + rho * beyond)
    cloud = (u * shares[:, None]).T @ u
    error = _jackknife(weighted, uc, ec, J, normal, shares)
    return LocalFit(J, center, origin, normal, cloud, error, s, rho, reach)


def _jackknife(
    weighted: Float64, u: Float64, e: Float64, J: Float64, normal: Float64, shares: Float64
) -> Float64:
    """Energy (d, d) of the error of J, by leaving out groups of consecutive samples."""
    number = min(_GROUPS, len(u) // 2)
    groups = np.minimum((np.cumsum(shares) * number).astype(np.intp), number - 1)
    products = weighted.T @ e
    error = np.zeros_like(normal)
    for group in np.unique(groups):
        out = groups == group
        rest = normal - weighted[out].T @ u[out]
        rest += 1e-9 * float(np.trace(normal)) / len(rest) * np.eye(len(rest))
        change = np.linalg.solve(rest, products - weighted[out].T @ e[out]) - J
        error += change @ change.T
    scaled: Float64 = error * (number - 1) / number
    return scaled


def _ridged(normal: Float64) -> Float64:
    """Normal equations (d, d) that can be solved: also of parameters that never moved."""
    diagonal = np.diag(normal)
    ridged: Float64 = normal + np.diag(_RIDGE * diagonal + 1e-12 * diagonal.mean() + _TINY)
    return ridged
