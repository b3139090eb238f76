"""Which of the samples that look like a solution belong to another one (a *twin*), far away.

An interval is local, and so is the linear model behind it.  A twin has the image of the solution at
other parameters; in one linear model with it, its samples would say that the step between the two
changes nothing.

1. A linear model is fitted to the samples whose parameters are nearest.  Where it says that a
   sample's image should differ from the solution's by far more than it does, the sample is a
   suspect.  Only directions count in which J exceeds its error several times: along one that the
   image does not show, nothing is suspect.
2. Far along a curve of equal images the linear model is wrong as well.  Such samples are joined to
   the solution by others on the way, so suspects that can be reached in small steps are kept: from
   the samples most like it, by way of suspects.
3. The other suspects are of twins.  So is every sample that 2 does not keep and that is nearer to
   one of them than to the solution, by the change of the image that the model expects.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search import mixed
from fide_plugins.types import Float64, Indices, Mask
from fide_plugins.uncertainty.local_fit import fit_locally
from fide_plugins.uncertainty.resolution import information

__all__ = ["of_twins"]

_FEWEST, _EACH = 60, 6  # samples of the first model, or so many a parameter
_CERTAIN = 4.0  # times its error, from which on J J^T counts here
_MORE = 10.0  # times as far away, squared, as the image says
_STEP = 0.15  # of the cube


def of_twins(u: Float64, e: Float64, distances: Float64, periodic: Mask | None) -> Mask:
    """(n,), samples that look like the solution and are not connected to it.

    u: (n, d), steps from the solution, n > d + 1.  e: (n, f), features.
    distances: (n,), squared, of their features from those of the solution; positive.
    periodic: (d,), None: no axis is.
    """
    number = max(_FEWEST, _EACH * u.shape[1])
    inner = np.sort(np.argsort(np.abs(u).max(axis=1), kind="stable")[:number])
    fit = fit_locally(u[inner], e[inner], distances[inner])
    seen = _seen(u, information(fit, _CERTAIN))
    expected = np.square(seen).sum(axis=1)
    suspects = expected > _MORE * np.maximum(distances, fit.reach)
    alike = inner[distances[inner] <= fit.reach]
    joined = _joined(u, suspects, alike, periodic)
    twins: Mask = suspects & ~joined
    for one in seen[twins]:
        twins |= ~joined & (np.square(seen - one).sum(axis=1) < expected)
    return twins


def _joined(u: Float64, suspects: Mask, latest: Indices, periodic: Mask | None) -> Mask:
    """(n,), suspects that are reached from `latest` (m,) in small steps, by way of suspects."""
    joined = np.zeros(len(u), bool)
    while len(latest):
        rest = np.flatnonzero(suspects & ~joined)
        latest = rest[[_gap(one, u[latest], periodic) <= _STEP for one in u[rest]]]
        joined[latest] = True
    return joined


def _seen(u: Float64, energy: Float64) -> Float64:
    """Coordinates (n, d) of u (n, d) in which the image changes by the length of a step."""
    values, vectors = np.linalg.eigh(energy)
    scaled: Float64 = u @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return scaled


def _gap(one: Float64, others: Float64, periodic: Mask | None) -> float:
    """The largest coordinate of the step from one (d,) to the nearest of others (m, d)."""
    return float(mixed.distance(others, one, periodic).max(axis=1).min())
