"""Random search, CMA-ES by the library `cma` (Hansen), and diffusion evolution."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Baseline, quietly, worse_than
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import one_of, positive
from fide_plugins.validation.points import whole_number


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
        (Auger and Hansen 2005), "bipop" has small populations with small steps in between, as many
        evaluations of both, by the rules of the library (Hansen 2009), "none" goes on with the
        search as it is.

    The other options are those of `Baseline`.  Raises OptionError.
    """

    name: ClassVar[str] = "cma"

    def __init__(
        self, dim: int, target: object = None, *, restarts: str = "same", **options: Any
    ) -> None:
        self.restarts = one_of("same", "ipop", "bipop", "none")("restarts", restarts)
        super().__init__(dim, target, **options)
        self.starts = 0  # searches begun so far
        self._ended = (np.inf, np.full(self.dim, 0.5))  # as `_present`, the best that is over
        self._first_popsize = self.popsize
        self._doublings, self._large, self._spent = 0, False, [0, 0]  # by small and large ones
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

    def _start(self, x0: Float64, sigma: float = 1.0, **limits: float) -> None:
        """Begin a search with a standard deviation of `sigma` sigma0."""
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
            **limits,
        }
        with quietly():  # it comments on dimension 1 and small populations
            self._es = cma.CMAEvolutionStrategy(x0, sigma * self.sigma0, settings)
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
            self._population.forget_pending()
            self._start(self._rng.random(self.dim), **self._next_search())

    def _next_search(self) -> dict[str, float]:
        """Set the population of the next search; its size of steps, and its limit if it has one."""
        self._spent[self._large] += self._es.countevals
        self._large = self.restarts == "ipop" or self._spent[0] >= self._spent[1]
        if self.restarts == "same":
            return {}
        if self._large:
            self._doublings += 1
            self.popsize = self._first_popsize * 2**self._doublings
            return {}
        small, sigma = self._rng.random() ** 2, 0.01 ** self._rng.random()
        self.popsize = int(self._first_popsize * 2 ** (self._doublings * small))
        return {"sigma": sigma, "maxiter": max(1.0, self._spent[1] / self.popsize / 2)}

    def _smallest_popsize(self) -> int:
        return 3

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        return {**super().settings(), "popsize": self._first_popsize}


class DiffusionEvolution(Baseline):
    """Evolution as the reverse of a diffusion (Zhang et al. 2024, arXiv:2410.02543).

    Each of the population z ~ N(0, 1), x = 1/2 + sigma0 z, estimates its origin as the mean of all,
    weighted by fitness and by how likely its own place is if the diffusion began at theirs; then it
    takes a step of DDIM.  Places are compared in a random projection on two axes.  The schedule is
    linear and ends with the budget; then it begins again.  Fitness is exp(-loss / s), s a share of
    the standard deviation of losses.

    temperature: this share.
    budget: evaluations that are planned.
    popsize: None: 64.

    Candidates beyond the box are moved to its edge.  Raises OptionError.
    """

    name: ClassVar[str] = "diffusion-evolution"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        temperature: float = 0.1,
        budget: int = 10_000,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        self.temperature = positive("temperature", temperature)
        self.budget = whole_number("budget", budget, 1)
        self._alphas = np.linspace(1e-8, 1 - 1e-4, max(3, self.budget // self.popsize))
        self._rng = np.random.default_rng(self.seed)
        self._begin()

    def _begin(self) -> None:
        self._step = 0
        projected = self._rng.standard_normal((self.dim, 2)) / np.sqrt(self.dim)
        self._latent = projected if self.dim > 2 else np.eye(self.dim)
        self._z = self._rng.standard_normal((self.popsize, self.dim))

    def _sample(self) -> Float64:
        return np.clip(0.5 + self.sigma0 * self._z, 0.0, 1.0)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._population.forget_pending()
        if self._step + 1 == len(self._alphas):
            return self._begin()
        now, after = self._alphas[self._step : self._step + 2]
        self._step += 1
        z, worst = (X - 0.5) / self.sigma0, np.max(losses[np.isfinite(losses)], initial=0.0)
        losses = np.where(np.isfinite(losses), losses, worse_than(float(worst)))
        spread = max(self.temperature * float(losses.std()), 1e-300)
        fitness = -(losses - losses.min()) / spread
        seen = z @ self._latent
        apart = np.square(seen[:, None] - np.sqrt(now) * seen).sum(axis=2)
        weights = fitness - apart / (2 * (1 - now))
        weights = np.exp(weights - weights.max(axis=1, keepdims=True))
        origin = weights @ z / weights.sum(axis=1, keepdims=True)
        noise = (z - np.sqrt(now) * origin) / np.sqrt(1 - now)
        variance = (1 - after) / (1 - now) * (1 - now / after)
        fresh = np.sqrt(variance) * self._rng.standard_normal(z.shape)
        stays = np.sqrt(after) * origin
        self._z = stays + fresh + np.sqrt(max(0.0, 1 - after - variance)) * noise

    def _default_popsize(self) -> int:
        return 64
