"""How far the image determines the parameters: standard deviations from a Jacobian.

The features of the best candidate are taken for those of the target plus independent noise of
variance sigma^2 = |e*|^2 / f, where e* is the residual of f features.  The prior of the parameters
is uniform in the unit cube.  Then their covariance is

    (J J^T / sigma^2 + 12)^-1,

with the Jacobian J (d, f) of the features: the ordinary one of least squares where the image
determines a parameter, and 1 / 12, that of the uniform law, where it does not.  It is local and
linear: of other basins it knows nothing.

Near the answer, candidates differ by less than single precision shows, and no Jacobian can be
fitted to them any more.  So the last one is remembered that was well above rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fide_plugins.proposers.jacobian import Jacobian
from fide_plugins.types import Float64

__all__ = ["Sensitivity", "information", "sensitivity"]

_CLEAR = 1e6  # times the error of eigenvalues, from which on a Jacobian is well above rounding
_BOX_VARIANCE = 1 / 12  # of the uniform law on [0, 1]
_TINY = 1e-300


def information(jacobian: Jacobian, scale: Float64) -> Float64 | None:
    """J J^T (d, d) per unit of the cube; None where rounding shows.

    scale: (d,), the units of the parameters that the Jacobian was fitted in.
    """
    if jacobian.values.mean() <= _CLEAR * jacobian.rounding:
        return None
    scaled = jacobian.vectors / scale[:, None]
    product: Float64 = (scaled * jacobian.values) @ scaled.T
    return product


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What the image says of the parameters of the best candidate.

    It is computed when it is first read, from what was known when this object was made.

    x: (d,), the best candidate.
    known: (d, d), of `information`.
    noise: variance of a feature.
    """

    x: Float64
    known: Float64
    noise: float

    @cached_property
    def _eigen(self) -> tuple[Float64, Float64]:
        """Variances (d,), falling, and their directions (d, d), in columns."""
        values, vectors = np.linalg.eigh(self.known / self.noise)
        return 1 / (np.maximum(values, 0.0) + 1 / _BOX_VARIANCE), vectors

    @property
    def covariance(self) -> Float64:
        """(d, d), of the parameters, in units of the unit cube."""
        variances, vectors = self._eigen
        product: Float64 = (vectors * variances) @ vectors.T
        return product

    @property
    def std(self) -> Float64:
        """(d,): square roots of the diagonal; 0.29 where the image says nothing."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def directions(self) -> Float64:
        """(d, d): eigenvectors of the covariance in rows, the least determined first."""
        return self._eigen[1].T

    @property
    def direction_std(self) -> Float64:
        """(d,): standard deviations along them, falling."""
        return np.sqrt(self._eigen[0])


def sensitivity(x: Float64, known: Float64, residual: Float64, rounding: float) -> Sensitivity:
    """What the image says of the parameters of a candidate x (d,).

    known: (d, d), of `information`.  residual: (f,), features that the target has and x has not.
    rounding: energy of the features' last digits.
    """
    energy = float(residual @ residual) + rounding + _TINY
    return Sensitivity(x.copy(), known, energy / max(1, len(residual)))
