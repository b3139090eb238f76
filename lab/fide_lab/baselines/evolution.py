"""Random search, and CMA-ES by the library `cma` (Hansen)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline, quietly, worse_than
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import one_of


class Random(Baseline):
    """Independent uniform points; options of `Baseline`.  Raises OptionError."""

    name: ClassVar[str] = "random"

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        self._rng = np.random.default_rng(self.seed)

    def _sample(self) -> Float64:
        return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        pass


class CMA(Baseline):
    """CMA-ES of the library `cma`, at the population you choose.

    A search starts at the center of the box with standard deviation sigma0 in all directions; the
    library's box transformation keeps candidates in [0, 1], and its criteria say when a search has
    come to its end; then another one starts from a uniformly random point.

    popsize: candidates a generation, at least 3; None: the library's default, 4 + 3 ln d.
    restarts: "same" starts again with the same population, "ipop" doubles it each time
        (Auger and Hansen 2005), "none" goes on with the search as it is.

    The other options are those of `Baseline`.  Raises OptionError.
    """

    name: ClassVar[str] = "cma"

    def __init__(
        self, dim: int, target: object = None, *, restarts: str = "same", **options: Any
    ) -> None:
        self.restarts = one_of("same", "ipop", "none")("restarts", restarts)
        super().__init__(dim, target, **options)
        self.starts = 0  # searches begun so far
        self._ended = (np.inf, np.full(self.dim, 0.5))  # as `_present`, the best that is over
        self._first_popsize = self.popsize
        self._rng = np.random.default_rng(self.seed)
        self._start(np.full(self.dim, 0.5))

    def recommend(self) -> Float64:
        """Mean (dim,) of the search that found the lowest loss, at its end or now; in the box."""
        _, mean = min(self._ended, self._present(), key=lambda search: search[0])
        return mean.copy()

    def _present(self) -> tuple[float, Float64]:
        """Lowest loss of the search under way, and the mean of its distribution."""
        mean = np.asarray(self._es.result.xfavorite, np.float64)
        return float(self._es.best.f), np.clip(mean, 0.0, 1.0)

    def _start(self, x0: Float64) -> None:
        try:
            import cma  # takes half a second
        except ImportError as error:
            raise missing("lab", "this optimizer needs the package cma") from error
        unlimited = {"maxstd_boundrange": np.inf} if self.dim == 1 else {}  # the limit fails there
        settings: dict[str, Any] = {
            **unlimited,
            "bounds": [0.0, 1.0],
            "seed": np.nan,  # the library's sign for: leave the global state alone
            "verbose": -10,  # silent, and no options read from files in the current folder
            "verb_log": 0,
            "signals_filename": None,
            "popsize": self.popsize,
            "randn": lambda *shape: self._rng.standard_normal(shape),  # not numpy's global state
        }
        with quietly():  # it comments on dimension 1 and small populations
            self._es = cma.CMAEvolutionStrategy(x0, self.sigma0, settings)
        self.starts += 1

    def _sample(self) -> Float64:
        with quietly():
            X = np.array(self._es.ask(self.popsize), np.float64)
        return np.clip(X, 0.0, 1.0)  # the transformation can be off by one rounding

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        with quietly():
            good = np.isfinite(losses)  # it calculates with losses: the same ranking, no infinity
            worst = worse_than(float(np.max(losses[good], initial=0.0)))
            self._es.tell(list(X), np.where(good, losses, worst).tolist())
            over = self.restarts != "none" and bool(self._es.stop())
        if over:
            self._ended = min(self._ended, self._present(), key=lambda search: search[0])
            if self.restarts == "ipop":
                self.popsize *= 2
            self._population.forget_pending()
            self._start(self._rng.random(self.dim))

    def _smallest_popsize(self) -> int:
        return 3

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        return {**super().settings(), "popsize": self._first_popsize}
