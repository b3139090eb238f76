"""Figures of a suite: shares of solved problems."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fide_lab.report import plots
from fide_lab.suite import profiles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fide_lab.suite.scores import Scores

__all__ = ["data_profile", "performance_profile"]


def data_profile(found: Scores, names: Sequence[str], legend: bool = True) -> Figure:
    """Figure of the share of problems solved within so many renders (Moré and Wild 2009).

    names: of the optimizers, in the order of found.labels.
    legend: the names are inside of the figure.
    """
    solved = found.t[np.isfinite(found.t)].tolist()
    begin = 0.5 * min([*solved, found.budgets[0]])
    at = np.unique([begin, *solved, float(found.budgets[-1])])
    shares = profiles.data_profile(found.t, at)
    return plots.profile(at, shares, names, "renders", legend, found.budgets)


def performance_profile(
    found: Scores, names: Sequence[str], budget: int, legend: bool = True
) -> Figure:
    """Figure of the share solved within tau times the renders of the fastest (Dolan and Moré 2002).

    budget: renders after which a problem counts as unsolved.
    names, legend: as for `data_profile`.
    """
    t = profiles.within(found.t, budget)
    ratios = profiles.performance_ratios(t)
    tau = np.unique([1.0, *ratios[np.isfinite(ratios)]])
    tau = np.append(tau, max(2.0, 1.3 * tau[-1]))
    shares = profiles.performance_profile(t, tau)
    return plots.profile(tau, shares, names, "renders / renders of the fastest optimizer", legend)
