"""How sure the parameters of a solution are: a standard deviation for each, from what was rendered.

=============  =======================================================================
`estimate`     the estimate of a solution in four steps, computed when it is read
`selection`    which remembered samples count for a solution
`features`     their features as numbers
`basin`        which of them are of another solution with the same image
`local_fit`    the Jacobian of the features there, and how well the samples tell it
`resolution`   in which directions the Jacobian says something, in which nothing is seen
`covariance`   noise of the target, error of the search, what nothing determines
`as_good`      which samples explain the target as well, and how far away these are
`values`       whether the picture tells one value of an integer or a choice from another
=============  =======================================================================

Nothing here is called before somebody reads `Solution.std`.
"""

from __future__ import annotations

from fide_plugins.uncertainty.covariance import covariance
from fide_plugins.uncertainty.estimate import LocalEstimate
from fide_plugins.uncertainty.local_fit import FitToTarget, LocalFit, fit_locally

__all__ = ["FitToTarget", "LocalEstimate", "LocalFit", "covariance", "fit_locally"]
