"""Dual annealing as SciPy has it: generalized simulated annealing with a local search.

The search visits points by a distorted Cauchy-Lorentz distribution (Tsallis and Stariolo 1996) and
descends from the best of them by L-BFGS-B, whose gradients are finite differences; each of their
dim + 1 evaluations counts.  It starts at the center of the box, with SciPy's defaults; where SciPy
would return (after 1,000 iterations), another search starts from a random point.

SciPy's finite differences are 1e-8 long.  An image of 32-bit numbers does not change by so little,
and its edges move by whole pixels: there most evaluations for gradients are wasted.  With `step` of
0.001 the same search is much stronger; `lab/reports/baselines.md` has both.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.reverse_communication import Search
from fide_lab.baselines.sequential import Sequential
from fide_plugins.types import Float64
from fide_plugins.validation.options import positive

__all__ = ["DualAnnealing", "anneal", "descent"]


class DualAnnealing(Sequential):
    """`scipy.optimize.dual_annealing` by ask and tell; options of `Baseline`.

    step: of the finite differences; None: SciPy's own, 1e-8.

    Without a step the points are those that SciPy evaluates with ``x0=np.full(dim, 0.5)`` and
    ``rng=np.random.default_rng(seed)``.  `sigma0` is not used; popsize is 1, and another one has
    no effect but a warning.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "dual-annealing"

    def __init__(
        self, dim: int, target: object = None, *, step: float | None = None, **options: Any
    ) -> None:
        super().__init__(dim, target, **options)
        self.step = None if step is None else positive("step", step)
        self._rng = np.random.default_rng(self.seed)

    def _search(self) -> Search:
        x0 = np.full(self.dim, 0.5) if self.starts == 0 else self._rng.random(self.dim)
        if self.step is None:
            return partial(anneal, x0=x0, rng=self._rng)
        local = descent(self.dim, self.step)
        return partial(anneal, x0=x0, rng=self._rng, minimizer_kwargs=local)

    def _own_settings(self) -> dict[str, Any]:
        return {"step": self.step}


def anneal(function: Any, x0: Float64, rng: np.random.Generator, **options: Any) -> None:
    """One search of SciPy's in the unit box, from x0."""
    from scipy.optimize import dual_annealing  # takes a tenth of a second

    dual_annealing(function, [(0.0, 1.0)] * len(x0), x0=x0, rng=rng, **options)


def descent(dim: int, step: float | None) -> dict[str, Any]:
    """Arguments of `scipy.optimize.minimize` for the local search, as `dual_annealing` has them.

    step: of the finite differences; None: SciPy's own.
    """
    differences = {} if step is None else {"eps": step}
    longest = min(max(6 * dim, 100), 1000)
    options = {"maxiter": longest, **differences}
    return {"method": "L-BFGS-B", "bounds": [(0.0, 1.0)] * dim, "options": options}
