"""BIPOP-CMA-ES (Hansen 2009): restarts with large and with small populations, in turn.

Through `cma.fmin2(bipop=True)`, the author's own code, which is called as it is.  The first search
has the default population.  After that, searches whose population doubles each time share the
evaluations equally with short ones of small populations and small steps.  The library's box
transformation keeps candidates in [0, 1].  The first search starts at the center of the box, the
others at uniformly random points, as the library recommends.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.called_back import CalledBack
from fide_lab.baselines.cma import library, library_settings
from fide_lab.baselines.global_random import GlobalRandom
from fide_lab.baselines.reverse_communication import Search
from fide_plugins.types import Float32, Float64

__all__ = ["BIPOP", "minimize", "start_points"]

RESTARTS = 9  # doublings of the population, as many as the library recommends


class BIPOP(CalledBack):
    """CMA-ES of the library `cma` with BIPOP restarts; options of `Baseline`.

    popsize: candidates of the first generations, at least 3; None: 4 + 3 ln d.  Later ones differ.

    Evaluations of the mean at the end of a search are the library's, and count.  If more than a
    generation is asked for, its candidates are given again; the first result of each is used.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "bipop-cma-es"

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        library()
        self._first_popsize = self.popsize
        self._global_random = GlobalRandom(self.seed)
        self._results: dict[bytes, float] = {}  # of the generation, by candidate

    def _search(self) -> Search:
        x0, settings = start_points(self.dim, self.starts == 0), library_settings(self.dim)
        if self._first_popsize != self._default_popsize():
            settings["popsize"] = (
                self._first_popsize
            )  # else the library doubles 4 + 3 ln d unrounded
        return partial(minimize, x0=x0, sigma0=self.sigma0, settings=settings)

    def _sample(self) -> Float64:
        return self._missing()

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        for x, loss in zip(X, losses.tolist(), strict=True):
            self._results.setdefault(x.tobytes(), loss)
        missing = self._missing()
        if not len(missing):
            points = self._points()
            self._go_on([self._penalty(self._results[x.tobytes()]) for x in points])
            self._results.clear()
            missing = self._missing()
        self.popsize = len(missing)

    def _missing(self) -> Float64:
        """Candidates of the generation without a result, (n, dim)."""
        points = self._points()
        unknown: Float64 = points[[x.tobytes() not in self._results for x in points]]
        return unknown

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        return self._global_random.lent_quietly

    def _smallest_popsize(self) -> int:
        return 3

    def _own_settings(self) -> dict[str, Any]:
        return {"popsize": self._first_popsize}


def minimize(
    function: Any, x0: Callable[[], Float64], sigma0: float, settings: dict[str, Any]
) -> None:
    """All searches of the library in the unit box; `function` takes points (k, d)."""
    library().fmin2(
        None, x0, sigma0, settings, parallel_objective=function, bipop=True, restarts=RESTARTS
    )


def start_points(dim: int, central: bool) -> Callable[[], Float64]:
    """What gives the points (dim,) to start from: the center first if `central`, then uniform ones.

    It draws from NumPy's global generator, as the library does.
    """
    return partial(_start_point, dim, [np.full(dim, 0.5)] if central else [])


def _start_point(dim: int, first: list[Float64]) -> Float64:
    return first.pop(0) if first else np.random.random(dim)
