"""In which directions of the parameters a linear model says something, and in which nothing shows.

J [d, f] has an error E (`local_fit`).  Directions are those of the generalized eigenvalue problem
of J J^T and E.

*Resolved*: J J^T exceeds E.  It is too large by E, which is subtracted.

*Unseen*: along it, even with the error, the image changes next to nothing, from one side of the
cube to the other, and the little it changes may be chance; also by the models of samples that are
less alike, since near the solution an image of hard edges changes with nothing.

Where the image does not change, J is nothing but its error, and the ratio of the two follows an F
distribution.  How wide that is depends on how many independent features the error has: noise has
hundreds, curvature a few, and then J may exceed its error several times.  They are counted as
tr(S)^2 / tr(S^2) of their covariance S (Satterthwaite 1946), from the products of different groups
of the jackknife.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from fide_plugins.types import Float64, Mask
from fide_plugins.uncertainty.local_fit import LocalFit, energy_of

__all__ = ["information", "unresolved", "unseen"]

_RESOLVED = 1.1  # times its error, from which on J J^T is more than that
_CHANCE = 0.99  # quantile of the ratio up to which it may be chance
_SMALL = 1e-9  # of the mean energy of J, which is the least error
_ROUNDING = 1e-13  # of the energy of an error: its last digits
_FEWER = 1e-6  # one over the most independent features that are counted
_TINY = float(np.finfo(np.float64).tiny)


class _Directions(NamedTuple):
    """Directions w_i with w_i^T E w_j = (i = j) and w_i^T J J^T w_i = ratio_i.

    steps: (d, d), w_i in its columns.  slopes: (d, d), with J J^T = slopes diag(ratios) slopes^T.
    ratios: (d,).  chance: (d,), whether J may be nothing but its error.
    """

    steps: Float64
    slopes: Float64
    ratios: Float64
    chance: Mask


def information(fit: LocalFit, least: float = _RESOLVED) -> Float64:
    """J J^T (d, d) without its error, in the directions in which it exceeds `least` times that."""
    found = _directions(fit.J, fit.changes, fit.normal)
    known = np.where(found.ratios > least, found.ratios - 1, 0.0)
    energy: Float64 = (found.slopes * known) @ found.slopes.T
    return energy


def unresolved(fit: LocalFit) -> Float64:
    """Orthonormal directions (d, k), k >= 0, of which `information` says nothing."""
    found = _directions(fit.J, fit.changes, fit.normal)
    steps: Float64 = np.linalg.qr(found.steps[:, found.ratios <= _RESOLVED])[0]
    return steps


def unseen(fit: LocalFit, from_afar: Sequence[LocalFit], most: float, rounding: float) -> Float64:
    """Orthonormal directions (d, m), m >= 0, that are unseen.

    from_afar: models of samples that are less alike.
    most: change of the features, squared, over the side of the cube, that is next to nothing.
    rounding: such a change that is only one of their last digits.
    """
    found = _directions(fit.J, fit.changes, fit.normal, rounding)
    basis = np.linalg.qr(found.steps[:, found.chance])[0]  # (d, k)
    changes = np.linalg.eigh(basis.T @ (fit.J @ fit.J.T + fit.error) @ basis)
    steps: Float64 = basis @ changes.eigenvectors[:, changes.eigenvalues <= most]
    for other in from_afar:
        if steps.shape[1]:
            steps = _unseen_there(steps, fit, other, rounding)
    return steps


def _unseen_there(steps: Float64, fit: LocalFit, other: LocalFit, rounding: float) -> Float64:
    """Those of the directions (d, m) of a model that another does not resolve either.

    They have the error of the first model, too, which counts beside that of the other.
    """
    changes = np.matmul(steps.T, np.concatenate([other.changes, fit.changes]))
    normal = np.linalg.inv(steps.T @ np.linalg.solve(other.normal, steps))
    inner = _directions(steps.T @ other.J, changes, normal, rounding)
    kept: Float64 = np.linalg.qr(steps @ inner.steps[:, inner.chance])[0]
    return kept


def _directions(J: Float64, changes: Float64, normal: Float64, least: float = 0.0) -> _Directions:
    """Of J (d, f), with its changes (g, d, f) and its normal matrix (d, d).

    least: added to the energy of its error in each direction.
    """
    scale = np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    values = np.maximum(values, 1e-14 * values[-1] + _TINY)
    root = (vectors * np.sqrt(values)) @ vectors.T * scale  # (d, d)
    back = (vectors / np.sqrt(values)) @ vectors.T / scale[:, None]
    J, changes = root @ J, np.matmul(root, changes)  # all directions alike
    energy = J @ J.T
    error = energy_of(changes) + least * root @ root.T
    small = _SMALL * float(np.trace(energy)) / len(energy)  # far less where J is only its error
    floor = max(small, _ROUNDING * float(np.trace(error))) + _TINY
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
        both / np.maximum(others, _FEWER * both + _TINY), 1.0
    )  # tr(S)^2 / tr(S^2)
    quantiles: Float64 = fdtri(features, features * (len(changes) - 1), _CHANCE)
    return quantiles
