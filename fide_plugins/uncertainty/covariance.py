"""The covariance of a solution's parameters, from a linear model of the features there.

1. *What is resolved.*  J has an error E (`local_fit`).  In the directions in which J J^T does not
   exceed E nothing was learned; in the others E is subtracted, since J J^T is too large by it.
   Directions are those of the generalized eigenvalue problem of the two.
2. *How far the truth is.*  With the residual r of the target, without what J explains of it,
   sigma^2 = |r|^2 / f: the noise of the target, and of as many renders as the model is made of.
   What J does explain is the search's own error: a finished search leaves d sigma^2 of it.  The
   truth is taken to be as far away, so the larger of sigma^2 and (explained / d) scales the
   inverse of J J^T.
3. *What nothing says.*  The prior is uniform in the cube, variance 1 / 12.  In a direction that is
   not resolved, the samples that look alike reach so far; the truth is taken to be at most `WIDER`
   times as far away as they are.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64
from fide_plugins.uncertainty.local_fit import FitToTarget, LocalFit

__all__ = ["WIDER", "covariance", "information", "scale_of", "unexplained"]

_RESOLVED = 1.1  # times its error, from which on J J^T is more than that
_BOX = 12.0  # one over the variance of the uniform law on [0, 1]
WIDER = 5.0
_STILL = 1e-18  # variance
_RIDGE = 1e-4  # of the mean eigenvalue
_ROUNDING = 1e-14  # of the target's energy: its last digits, in single precision


def covariance(model: FitToTarget) -> Float64:
    """(d, d), in units of the unit cube."""
    fit, d = model.fit, len(model.fit.J)
    cloud = WIDER**2 * fit.cloud
    cloud += 1e-12 * (1 + float(np.trace(cloud)) / d) * np.eye(d)
    still = np.diag(fit.cloud) < _STILL  # such a parameter never moved: nothing is known of it
    cloud[still], cloud[:, still] = 0.0, 0.0
    cloud[still, still] = 1.0
    known = information(fit) / scale_of(model)
    known[still], known[:, still] = 0.0, 0.0
    reach = np.linalg.inv(cloud)
    reach[still, still] = 0.0
    precision = known + reach + _BOX * np.eye(d)
    return np.asarray(np.linalg.inv(precision), np.float64)


def scale_of(model: FitToTarget) -> float:
    """Variance of a feature that the truth is away."""
    fit, target, f = model
    residual = model.residual
    left = unexplained(fit, residual)
    noise = float(left @ left)
    explained = float(residual @ residual) - noise
    rounding = _ROUNDING * float(target @ target) + np.finfo(np.float64).tiny
    return max(noise / f, explained / len(fit.J), rounding / f)


def unexplained(fit: LocalFit, residual: Float64) -> Float64:
    """What the parameters cannot explain of a residual (f,)."""
    d = len(fit.J)
    energy = fit.J @ fit.J.T
    ridge = _RIDGE * float(np.trace(energy)) / d + np.finfo(np.float64).tiny
    left: Float64 = residual - np.linalg.solve(energy + ridge * np.eye(d), fit.J @ residual) @ fit.J
    return left


def information(fit: LocalFit, least: float = _RESOLVED) -> Float64:
    """J J^T (d, d) without its error, in the directions in which it exceeds `least` times that."""
    values, vectors = np.linalg.eigh(fit.normal)
    values = np.maximum(values, 1e-14 * values[-1] + np.finfo(np.float64).tiny)
    root = (vectors * np.sqrt(values)) @ vectors.T  # of the normal matrix: all directions alike
    energy = root @ (fit.J @ fit.J.T) @ root
    error = root @ fit.error @ root
    floor = 1e-9 * float(np.trace(energy)) / len(energy) + np.finfo(np.float64).tiny
    L = np.linalg.cholesky(error + floor * np.eye(len(error)))
    inner = np.linalg.solve(L, np.linalg.solve(L, energy).T)
    ratios, directions = np.linalg.eigh((inner + inner.T) / 2)
    known = np.where(ratios > least, ratios - 1, 0.0)
    X = ((vectors / np.sqrt(values)) @ vectors.T) @ L @ directions
    information: Float64 = (X * known) @ X.T
    return information
