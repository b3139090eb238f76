"""Random search, CMA-ES by the library `cma` (Hansen) in three versions, and PGPE with ClipUp.

Searches of the library start at the center of the box with standard deviation sigma0, in all
directions; its own box transformation keeps candidates in [0, 1], and its own criteria say when a
search has come to its end; then another one starts from a uniformly random point.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.base import Replayed, quietly, worse_than
from fide_lab.baselines.libraries import CalledBack, GlobalRandom, Search, Sequential
from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import fraction, positive


class Random(Replayed):
    """Independent points from the uniform distribution on [0, 1]^dim; options of `Baseline`.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "random"

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        self._rng = np.random.default_rng(self.seed)

    def _sample(self) -> Float64:
        return self._rng.random((self.popsize, self.dim))  # ~ U(0, 1)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        pass


RESTARTS = ("same", "ipop", "none")


class CMA(Replayed):
    """CMA-ES of the library `cma`, at the population you choose.

    popsize: candidates a generation, at least 3; None: the library's default, 4 + 3 ln d.
    restarts: "same" starts again with the same population, "ipop" doubles it each time
        (Auger and Hansen 2005), "none" goes on with the search as it is.

    The other options are those of `Baseline`.

    Raises OptionError (a ValueError).
    """

    name: ClassVar[str] = "cma"

    def __init__(
        self, dim: int, target: object = None, *, restarts: str = "same", **options: Any
    ) -> None:
        if restarts not in RESTARTS:
            raise OptionError(f"restarts must be one of {', '.join(RESTARTS)}, not {restarts!r}")
        super().__init__(dim, target, **options)
        self.restarts = restarts
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
        cma = library()
        settings = {
            **library_settings(self.dim),
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
            self._es.tell(list(X), _finite(losses).tolist())
            over = self.restarts != "none" and bool(self._es.stop())
        if over:
            self._ended = min(self._ended, self._present(), key=lambda search: search[0])
            if self.restarts == "ipop":
                self.popsize *= 2
            self._population.forget_pending()
            self._start(self._rng.random(self.dim))

    def _smallest_popsize(self) -> int:
        return 3

    def _own_settings(self) -> dict[str, Any]:
        return {"restarts": self.restarts, "popsize": self._first_popsize}


def library() -> Any:
    """The package `cma`, which takes half a second to import; DependencyError without it."""
    try:
        import cma
    except ImportError as error:
        raise missing("lab", "this optimizer needs the package cma") from error
    return cma


def library_settings(dim: int) -> dict[str, Any]:
    """Options of the library for all that use it here."""
    unlimited = {"maxstd_boundrange": np.inf} if dim == 1 else {}  # the limit fails in dimension 1
    return {
        **unlimited,
        "bounds": [0.0, 1.0],
        "seed": np.nan,  # the library's sign for: leave the global state alone
        "verbose": -10,  # silent, and no options read from files in the current folder
        "verb_log": 0,
        "signals_filename": None,
    }


def _finite(losses: Float64) -> Float64:
    """Losses with the same ranking and no infinity, since the library calculates with them."""
    good = np.isfinite(losses)
    if good.all():
        return losses
    worst = float(np.max(losses[good], initial=0.0))
    return np.where(good, losses, worse_than(worst))


DOUBLINGS = 9  # doublings of the population, as many as the library recommends


class BIPOP(CalledBack):
    """CMA-ES of the library `cma` with BIPOP restarts (Hansen 2009); options of `Baseline`.

    Through `cma.fmin2(bipop=True)`.  The first search has the default population.  After that,
    searches whose population doubles each time share the evaluations equally with short ones of
    small populations and small steps.

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
        None, x0, sigma0, settings, parallel_objective=function, bipop=True, restarts=DOUBLINGS
    )


def start_points(dim: int, central: bool) -> Callable[[], Float64]:
    """What gives the points (dim,) to start from: the center first if `central`, then uniform ones.

    It draws from NumPy's global generator, as the library does.
    """
    return partial(_start_point, dim, [np.full(dim, 0.5)] if central else [])


def _start_point(dim: int, first: list[Float64]) -> Float64:
    return first.pop(0) if first else np.random.random(dim)


class LQCMA(Sequential):
    """CMA-ES of the library `cma` with its linear-quadratic model (Hansen 2019); see `Baseline`.

    Through `cma.fmin_lq_surr2`.  Of each generation only so many candidates are evaluated, one
    after the other, that a global model ranks them as their losses do (Kendall's tau); its minimum
    is injected into the next generation.  A full quadratic model of d parameters has
    (d + 1) (d + 2) / 2 coefficients; with 40 parameters the library takes longer to fit it than
    most renderers to render.

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
        return partial(minimize_with_model, x0=x0, sigma0=self.sigma0, settings=settings)

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        return self._global_random.lent_quietly


def minimize_with_model(
    function: Any, x0: Callable[[], Float64], sigma0: float, settings: dict[str, Any]
) -> None:
    """All searches of the library in the unit box."""
    library().fmin_lq_surr2(function, x0, sigma0, settings, restarts=DOUBLINGS)


_UNIT = 1 / 4  # of the box: one unit of es-clip's space
_LARGEST_CHANGE = 0.2  # of a standard deviation in a generation, as in pgpelib


class PGPE(Replayed):
    """Gradient ascent on a Gaussian's center and standard deviations; options of `Baseline`.

    Policy gradients with parameter-based exploration (Sehnke et al. 2010,
    10.1016/j.neunet.2009.12.004) follow the gradient of the expected rank of a sample of
    N(c, diag(sigma^2)).  ClipUp (Toklu et al. 2020, arXiv:2008.02387) gives each gradient of c the
    same length, and bounds the speed.  The settings are those of es-clip, which draws pictures by
    triangles (Tian and Ha 2022, arXiv:2109.08857), in a space without bounds; here the box is four
    of its units wide.

    popsize: candidates a generation, an even number; None: es-clip's 256.
    rate: length of the step to which each gradient of the center is scaled, in units of the box.
    max_speed: longest step of the center in a generation, in units of the box.
    momentum: share of the velocity that stays, in [0, 1].
    std_rate: learning rate of the standard deviations.

    Candidates beyond the box are moved to its edge, and count as where they were rendered.

    Raises OptionError (a ValueError) for options out of range.
    """

    name: ClassVar[str] = "pgpe"
    own_options = ("rate", "max_speed", "momentum", "std_rate")

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        sigma0: float = 0.1 * _UNIT,
        rate: float = 0.15 * _UNIT,
        max_speed: float = 0.15 * _UNIT,
        momentum: float = 0.9,
        std_rate: float = 0.1,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, sigma0=sigma0, **options)
        if self.popsize % 2:
            raise OptionError(f"popsize must be even, for mirrored samples; not {self.popsize}")
        self.rate, self.max_speed = positive("rate", rate), positive("max_speed", max_speed)
        self.momentum = fraction("momentum", momentum)
        self.std_rate = positive("std_rate", std_rate)
        self._rng = np.random.default_rng(self.seed)
        self._center = np.full(self.dim, 0.5)
        self._std = np.full(self.dim, self.sigma0)
        self._velocity = np.zeros(self.dim)

    def recommend(self) -> Float64:
        """Center (dim,) of the distribution."""
        return self._center.copy()

    def _sample(self) -> Float64:
        noise = self._std * self._rng.standard_normal((self.popsize // 2, self.dim))
        mirrored = np.stack([noise, -noise], axis=1).reshape(self.popsize, self.dim)
        samples: Float64 = np.clip(self._center + mirrored, 0, 1)
        return samples

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        ranks = _centered_ranks(losses)
        away = X - self._center
        to_center = ranks @ away / len(X)
        to_std = (ranks - ranks.mean()) @ (away**2 - self._std**2) / self._std / len(X)
        self._velocity = self._clip_up(to_center)
        self._center = np.clip(self._center + self._velocity, 0, 1)
        change = _LARGEST_CHANGE * self._std
        self._std = self._std + np.clip(self.std_rate * to_std, -change, change)

    def _clip_up(self, gradient: Float64) -> Float64:
        """Next velocity (d,): the gradient scaled to one length, and the speed bounded."""
        length = float(np.linalg.norm(gradient))
        step = self.rate * gradient / length if length > 0 else gradient
        velocity = self.momentum * self._velocity + step
        speed = float(np.linalg.norm(velocity))
        return velocity * (self.max_speed / speed) if speed > self.max_speed else velocity

    def _default_popsize(self) -> int:
        return 256

    def _smallest_popsize(self) -> int:
        return 2


def _centered_ranks(losses: Float64) -> Float64:
    """Ranks (k,) from 1/2 for the lowest loss to -1/2 for the highest; equal ones as they come."""
    ranks = np.empty(len(losses))
    ranks[np.argsort(losses, kind="stable")] = np.linspace(0.5, -0.5, len(losses))
    return ranks
