"""lq-CMA-ES (Hansen 2019): CMA-ES whose losses come from a linear or quadratic model where it can.

Through `cma.fmin_lq_surr2`, the author's own code, which is called as it is.  A global model is
fitted to the evaluated candidates.  Of each generation only so many candidates are evaluated, one
after the other, that the model ranks them as their losses do (Kendall's tau).  The minimum of the
model is injected into the next generation.

A full quadratic model of d parameters has (d + 1) (d + 2) / 2 coefficients: 21 for 5 parameters,
861 for 40.  With 40 parameters the library takes longer to fit it than most renderers to render.

The first search starts at the center of the box, the others at uniformly random points with twice
the population each time.  The library's box transformation keeps candidates in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar

from fide_lab.baselines.bipop import RESTARTS, start_points
from fide_lab.baselines.cma import library, library_settings
from fide_lab.baselines.global_random import GlobalRandom
from fide_lab.baselines.reverse_communication import Search
from fide_lab.baselines.sequential import Sequential
from fide_plugins.types import Float64

__all__ = ["LQCMA", "minimize"]


class LQCMA(Sequential):
    """CMA-ES of the library `cma` with its linear-quadratic model; options of `Baseline`.

    popsize is 1, what is evaluated at a time, and another one has no effect but a warning; the
    population is the library's, 4 + 3 ln d at first.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "lq-cma-es"

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        library()
        self._global_random = GlobalRandom(self.seed)

    def _search(self) -> Search:
        x0, settings = start_points(self.dim, self.starts == 0), library_settings(self.dim)
        return partial(minimize, x0=x0, sigma0=self.sigma0, settings=settings)

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        return self._global_random.lent_quietly


def minimize(
    function: Any, x0: Callable[[], Float64], sigma0: float, settings: dict[str, Any]
) -> None:
    """All searches of the library in the unit box."""
    library().fmin_lq_surr2(function, x0, sigma0, settings, restarts=RESTARTS)
