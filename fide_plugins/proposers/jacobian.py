"""The Jacobian of the features, fitted to evaluated candidates.

Notation: u [n, d], parameters minus those of the best candidate b, in units of a scale; e [n, f],
features minus those of b; J [d, f], e ~ u J; G [n, n], e e^T.

J is fitted in two stages, each a ridge regression with weights:

1. *wide*: J_0 from all candidates that are remembered, those farther away weighing less.  It knows
   every direction that was ever tried, and is an average over curved functions.
2. *near*: the residuals e - u J_0 of the 2 d nearest candidates, each divided by its distance, are
   regressed in the same way; the result corrects J_0.  Of a smooth function the error of e - u J
   falls with the square of the distance, so the nearest say most of the Jacobian at b itself, and
   steps converge as those of the secant method do.

Both are linear in e, so J = Q e with a matrix Q of d by n, and all that steps need,

    J J^T = Q G Q^T    and    J e* = Q (e e*^T),

comes from scalar products of features: an image costs n of them once, whatever f is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fide_plugins.types import Float64, Indices

__all__ = ["Jacobian", "fit_jacobian", "positive"]

_TINY = 1e-300
_SMALLEST_STD = 1e-9  # of the widest parameter's
_SMALLEST_GAP = 1e-4  # of a leverage to 1


class Jacobian(NamedTuple):
    """Of the features at candidate b, with respect to u."""

    best: int
    """b, index in the buffer."""
    Q: Float64
    """(d, n): J = Q e."""
    values: Float64
    """(d,): eigenvalues of J J^T, rising, at least 0."""
    vectors: Float64
    """(d, d): its eigenvectors, in columns."""
    rounding: float
    """Error of the eigenvalues."""
    curvature: float
    """c: |e - u J|^2 ~ c |u|^4."""


def fit_jacobian(
    u: Float64, gram: Float64, best: int, ridge: tuple[float, float], rounding: float = 0.0
) -> Jacobian:
    """Fit J to steps u (n, d) from candidate `best` and the scalar products of features (n, n).

    gram: of features around any origin.  ridge: penalties of the wide and the near regression.
    rounding: error of an entry of `gram`.
    """
    d = u.shape[1]
    G = gram - gram[best] - gram[best][:, None] + gram[best, best]  # (n, n)
    squared = np.einsum("nd,nd->n", u, u)  # (n,)
    Q = _wide(u, squared, ridge[0])
    near = _nearest(squared, 2 * d)
    curvature = 0.0
    if len(near):
        change, leverages = _near(u, squared, near, Q, ridge[1])
        Q = Q + change
        curvature = _curvature(u, squared, near, Q, G, leverages)
    values, vectors = np.linalg.eigh(Q @ G @ Q.T)
    error = rounding * float(np.square(Q).sum()) / d
    return Jacobian(best, Q, np.maximum(values, 0.0), vectors, error, curvature)


def _wide(u: Float64, squared: Float64, penalty: float) -> Float64:
    """Q (d, n) of J_0: all candidates, weighing less the farther away they are."""
    weights = 1 / (squared + max(float(np.median(squared)), _TINY))
    return _solve(u * weights[:, None], u, penalty)


def _near(
    u: Float64, squared: Float64, near: Indices, Q: Float64, penalty: float
) -> tuple[Float64, Float64]:
    """Change of Q (d, n) by the residuals of the nearest, in units of their distance; leverages."""
    distances = np.sqrt(squared[near])
    a = u[near] / distances[:, None]  # (n', d)
    P = _solve(a, a, penalty)  # (d, n')
    leverages = np.einsum("nd,dn->n", a, P)
    P /= distances  # of residuals that are not yet divided
    change = -(P @ u[near]) @ Q
    change[:, near] += P
    return change, leverages


def _curvature(
    u: Float64, squared: Float64, near: Indices, Q: Float64, G: Float64, leverages: Float64
) -> float:
    """Mean curvature c, of |e - u J|^2 ~ c |u|^4, by the nearest, each left out (PRESS)."""
    wrong = -u[near] @ Q  # (n', n): of e
    wrong[np.arange(len(near)), near] += 1.0
    energy = np.maximum(np.einsum("in,in->i", wrong @ G, wrong), 0.0)
    energy /= np.square(np.maximum(1 - leverages, _SMALLEST_GAP))
    return float(energy.sum() / max(float(np.square(squared[near]).sum()), _TINY))


def _solve(weighted: Float64, u: Float64, penalty: float) -> Float64:
    """(u^T W u + p)^-1 u^T W, (d, n), from W u and u (n, d)."""
    normal = u.T @ weighted
    p = penalty * float(np.trace(normal)) / len(normal) + _TINY
    return np.asarray(np.linalg.solve(normal + p * np.eye(len(normal)), weighted.T), np.float64)


def _nearest(squared: Float64, n: int) -> Indices:
    """The n candidates of smallest squared distance (k,) that is not 0."""
    order = np.argsort(squared, kind="stable")
    moved: Indices = order[squared[order] > 0][:n]
    return moved


def positive(std: Float64) -> Float64:
    """Standard deviations (d,) that can be divided by."""
    floor = max(_SMALLEST_STD * float(std.max()), 1e-15)
    scales: Float64 = np.maximum(std, floor)
    return scales
