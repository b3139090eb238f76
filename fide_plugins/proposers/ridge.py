"""Ridge regression by scalar products, and how well it predicts what it was not fitted to.

Notation: G [n, n], scalar products of the features of n examples; u [n, d], what they are to
predict; p, the penalty.  The coefficients (G + p)^-1 u predict of features with the products g the
values g^T (G + p)^-1 u.  The residuals are p (G + p)^-1 u, and the leverages, how much of its own
prediction each example makes, are the diagonal of G (G + p)^-1 = 1 - p (G + p)^-1 (Allen 1974).

(G + p)^-1 by Cholesky takes a fifth of the time of the eigenvalues of G (0.05 and 0.25 ms for 60
examples, 0.23 and 1.2 ms for 120; one core of an AMD EPYC).  Those are for penalties so small that
G + p may be singular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from fide_plugins.types import Float64

__all__ = ["Ridge", "ridge"]

_SAFE = 1e-4  # smallest penalty for the inverse; then G + p is conditioned well enough


class Ridge(NamedTuple):
    """Coefficients (n, d); residuals (n, d) and leverages (n,) of the examples."""

    coefficients: Float64
    residuals: Float64
    leverages: Float64


def ridge(gram: Float64, u: Float64, penalty: float, rounding: float) -> Ridge:
    """Regress u (n, d) on features with the scalar products `gram` (n, n).

    penalty: p, in units of the trace of `gram` over min(n, 64); rounding: added to it.
    """
    n = len(gram)
    if penalty >= _SAFE:
        p = penalty * float(np.trace(gram)) / min(n, 64) + rounding
        factor, failed = torch.linalg.cholesky_ex(torch.from_numpy(gram + p * np.eye(n)))
        if not failed:
            inverse: Float64 = torch.cholesky_inverse(factor).numpy()
            coefficients = inverse @ u
            return Ridge(coefficients, p * coefficients, 1 - p * np.diag(inverse))
    eigenvalues, vectors = np.linalg.eigh(gram)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    p = penalty * eigenvalues.sum() / min(n, 64) + rounding
    rotated = vectors.T @ u
    shrinkage = eigenvalues / (eigenvalues + p)
    residuals = u - vectors @ (shrinkage[:, None] * rotated)
    return Ridge((vectors / (eigenvalues + p)) @ rotated, residuals, vectors**2 @ shrinkage)
