"""Profiles of solvers over a set of problems.

======  =======  ===============================================================================
symbol  shape    meaning
======  =======  ===============================================================================
t       (P, S)   renders after which solver s has solved problem p; infinite if it has not
r       (P, S)   t over the least t of the problem, the performance ratio
======  =======  ===============================================================================

*Data profile* (Moré and Wild 2009; COCO's run-time distributions): the share of problems that are
solved within so many renders.  *Performance profile* (Dolan and Moré 2002): the share of problems
that a solver solves within tau times the renders of the fastest solver of each.  A problem that
nobody solves counts as unsolved by all, so that shares of both kinds have one denominator.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fide_plugins.types import Float64

__all__ = ["data_profile", "performance_profile", "performance_ratios", "within"]


def data_profile(t: Float64, renders: npt.ArrayLike) -> Float64:
    """Share (m, S) of problems that are solved within each of `renders`, (m,)."""
    return _shares(t, np.asarray(renders, np.float64))


def performance_profile(t: Float64, tau: npt.ArrayLike) -> Float64:
    """Share (m, S) of problems whose performance ratio is at most each of `tau`, (m,) >= 1."""
    return _shares(performance_ratios(t), np.asarray(tau, np.float64))


def performance_ratios(t: Float64) -> Float64:
    """r, (P, S); infinite where t is."""
    fastest = t.min(axis=1, keepdims=True)
    ratios = np.full(t.shape, np.inf)
    np.divide(t, fastest, out=ratios, where=np.isfinite(t))
    return ratios


def within(t: Float64, budget: float) -> Float64:
    """t, infinite where it exceeds the budget."""
    return np.where(t <= budget, t, np.inf)


def _shares(values: Float64, limits: Float64) -> Float64:
    if not len(values):
        raise ValueError("a profile needs at least one problem")
    solved = values[None] <= limits[:, None, None]  # (m, P, S)
    shares: Float64 = (solved & np.isfinite(values)).mean(axis=1)
    return shares
