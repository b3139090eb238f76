"""The covariance of a solution's parameters, from a linear model of the features there.

1. *What is resolved.*  J has an error E (`local_fit`).  In the directions in which J J^T does not
   exceed E nothing was learned; in the others E is subtracted (`resolution`).
2. *How far the truth is.*  With the residual r of the target, without what J explains of it,
   sigma^2 = |r|^2 / f: the noise of the target, and of as many renders as the model is made of;
   f counts independent features, of which a gray picture has a third.
   What J does explain is the search's own error: a finished search leaves d sigma^2 of it.  The
   truth is taken to be as far away, so the larger of sigma^2 and (explained / d) scales the
   inverse of J J^T.
3. *What nothing says.*  The prior is uniform in the cube, variance 1 / 12.  In the directions that
   are not resolved, and only there, the samples that look alike reach so far; the truth is taken
   to be at most `WIDER` times as far away as they are.  That holds where the search has looked
   farther and found other images.  A Gauss-Newton step leaves a parameter without effect where it
   is, so samples may lie together although the image says nothing.  Where it is known to change
   next to nothing (`unseen`), only the prior counts.
4. *What changes in jumps.*  Near a solution an image of hard edges changes with nothing, too.  So
   a parameter that 3 leaves open is, in the directions of 3, at most `WIDER` times as far away as
   samples with an image as good, unless samples speak for any value (`as_good`).
"""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64
from fide_plugins.uncertainty.local_fit import FitToTarget, LocalFit
from fide_plugins.uncertainty.resolution import information, unresolved, unseen

__all__ = ["NO_EFFECT", "WIDER", "covariance", "deviations", "noise_of", "scale_of", "unexplained"]

_BOX = 12.0  # one over the variance of the uniform law on [0, 1]
WIDER = 5.0
NO_EFFECT = 1e-3  # of the largest change of the image in the run, squared: 3 % of it
_RIDGE = 1e-4  # of the mean eigenvalue
_STILL = 1e-6  # of the cube: samples as good may be nowhere else
_SAME = 1e-8  # sine of an angle of directions that are one
_DIGITS = float(np.finfo(np.float64).eps)  # of the largest eigenvalue, for each parameter
_ROUNDING = 1e-14  # of the target's energy: its last digits, in single precision


def covariance(model: FitToTarget) -> Float64:
    """(d, d), in units of the unit cube."""
    fit, d = model.fit, len(model.fit.J)
    steps = unseen(fit, model.from_afar, NO_EFFECT * model.farthest, _rounding(model))
    rest = unresolved(fit)
    known = information(fit) / scale_of(model) + _reach(fit.cloud, rest)
    along = np.eye(d) - steps @ steps.T
    precision = along @ known @ along + _BOX * np.eye(d)
    if model.as_far is not None:
        precision += _limits(model.as_far, np.hstack([steps, rest]))
    return _inverse(precision)


def deviations(model: FitToTarget) -> Float64:
    """Standard deviations (d,), in units of the unit cube."""
    std: Float64 = np.sqrt(np.diag(covariance(model)))
    return std


def _inverse(precision: Float64) -> Float64:
    """Inverse (d, d), positive also where the last digits of its largest directions hide others.

    Of directions that they hide only the prior is known, which is in `precision` (d, d), symmetric.
    """
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


def _limits(as_far: Float64, steps: Float64) -> Float64:
    """Precision (d, d) in the span of `steps` (d, k), by how far away the truth may be (d,)."""
    limits = 1 / np.maximum(as_far, _STILL) ** 2
    vectors, sizes, _ = np.linalg.svd(steps, full_matrices=False)
    span = vectors[:, sizes > _SAME]
    projector = span @ span.T
    precision: Float64 = (projector * limits) @ projector
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
    return _ROUNDING * float(model.target @ model.target) + float(np.finfo(np.float64).tiny)


def unexplained(fit: LocalFit, residual: Float64) -> Float64:
    """What the parameters cannot explain of a residual (f,)."""
    d = len(fit.J)
    energy = fit.J @ fit.J.T
    ridge = _RIDGE * float(np.trace(energy)) / d + np.finfo(np.float64).tiny
    left: Float64 = residual - np.linalg.solve(energy + ridge * np.eye(d), fit.J @ residual) @ fit.J
    return left
