"""The covariance of a solution's parameters, from a linear model of the features there.

1. *What is resolved.*  J has an error E (`local_fit`).  In the directions in which J J^T does not
   exceed E nothing was learned; in the others E is subtracted (`resolution`).
2. *How far the truth is.*  With the residual r of the target, without what J explains of it,
   sigma^2 = |r|^2 / f: the noise of the target, and of as many renders as the model is made of.
   What J does explain is the search's own error: a finished search leaves d sigma^2 of it.  The
   truth is taken to be as far away, so the larger of sigma^2 and (explained / d) scales the
   inverse of J J^T.
3. *What nothing says.*  The prior is uniform in the cube, variance 1 / 12.  In a direction that is
   not resolved, the samples that look alike reach so far; the truth is taken to be at most `WIDER`
   times as far away as they are.  That holds where the search has looked farther and found other
   images.  A Gauss-Newton step leaves a parameter without effect where it is, so samples may lie
   together although the image says nothing.  Where it is known to change next to nothing
   (`unseen`), only the prior counts.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64
from fide_plugins.uncertainty.local_fit import FitToTarget, LocalFit
from fide_plugins.uncertainty.resolution import information, unseen

__all__ = ["WIDER", "covariance", "scale_of", "unexplained"]

_BOX = 12.0  # one over the variance of the uniform law on [0, 1]
WIDER = 5.0
_NOTHING = 1e-3  # of the largest change of the image in the run, squared: 3 % of it
_RIDGE = 1e-4  # of the mean eigenvalue
_ROUNDING = 1e-14  # of the target's energy: its last digits, in single precision


def covariance(model: FitToTarget) -> Float64:
    """(d, d), in units of the unit cube."""
    fit, d = model.fit, len(model.fit.J)
    steps = unseen(fit, model.from_afar, _NOTHING * model.farthest, _rounding(model))
    known = information(fit) / scale_of(model)
    along = np.eye(d) - steps @ steps.T
    precision = along @ known @ along + _reach(fit.cloud, steps) + _BOX * np.eye(d)
    return np.asarray(np.linalg.inv(precision), np.float64)


def _reach(cloud: Float64, steps: Float64) -> Float64:
    """Precision (d, d) by how far samples that look alike reach; none along `steps` (d, m)."""
    d, m = steps.shape
    wider = WIDER**2 * cloud
    wider += 1e-12 * (1 + float(np.trace(wider)) / d) * np.eye(d)
    across = np.linalg.qr(steps, mode="complete")[0][:, m:]
    precision: Float64 = across @ np.linalg.solve(across.T @ wider @ across, across.T)
    return precision


def scale_of(model: FitToTarget) -> float:
    """Variance of a feature that the truth is away."""
    fit, f = model.fit, model.f
    residual = model.residual
    left = unexplained(fit, residual)
    noise = float(left @ left)
    explained = float(residual @ residual) - noise
    return max(noise / f, explained / len(fit.J), _rounding(model) / f)


def _rounding(model: FitToTarget) -> float:
    """Energy of the last digits of the features."""
    return _ROUNDING * float(model.target @ model.target) + float(np.finfo(np.float64).tiny)


def unexplained(fit: LocalFit, residual: Float64) -> Float64:
    """What the parameters cannot explain of a residual (f,)."""
    d = len(fit.J)
    energy = fit.J @ fit.J.T
    ridge = _RIDGE * float(np.trace(energy)) / d + np.finfo(np.float64).tiny
    left: Float64 = residual - np.linalg.solve(energy + ridge * np.eye(d), fit.J @ residual) @ fit.J
    return left
