"""How sure the parameters of a solution are: a standard deviation for each.

============  =======================================================================
file          idea
============  =======================================================================
`at_answer`   at the end of a fit, by renders around the answer
`estimate`    elsewhere, from samples of the search, computed when it is read
`samples`     which remembered samples count for a solution
`local_fit`   a linear model of their features, and the covariance that follows
============  =======================================================================
"""

from __future__ import annotations

from fide_plugins.uncertainty.estimate import LocalEstimate
from fide_plugins.uncertainty.local_fit import FitToTarget, LocalFit, covariance, fit_locally

__all__ = ["FitToTarget", "LocalEstimate", "LocalFit", "covariance", "fit_locally"]
