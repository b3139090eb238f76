"""Any optimizer of Nevergrad or Optuna, by the name it has there.

They see losses only, start at the center of the box, and are given no more than a user would give:
the bounds, the number of workers, the budget and a seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.global_random import GlobalRandom
from fide_lab.baselines.penalty import Penalty, quietly
from fide_lab.baselines.replay import Replayed
from fide_plugins.errors import OptimizerError, UnknownNameError
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import whole_number

__all__ = ["Framework", "Nevergrad", "Optuna", "nevergrad", "optuna"]


class Framework(Replayed):
    """An optimizer of a framework, whose own candidate objects are told back to it.

    popsize: points that are evaluated at the same time, 1 by default; the population is the
        library's own affair.
    budget: evaluations that are planned, which some optimizers count on.

    The other options are those of `Baseline`; `sigma0` is not used, and failed evaluations are
    told as worse than all others.
    """

    method: ClassVar[str]
    """Name in the framework."""

    def __init__(
        self, dim: int, target: object = None, *, budget: int = 10_000, **options: Any
    ) -> None:
        super().__init__(dim, target, **options)
        self.budget = whole_number("budget", budget, 1)
        self._penalty = Penalty()
        self._global_random = GlobalRandom(self.seed)
        self._candidates: dict[bytes, list[Any]] = {}  # the framework's, by our point
        with self._guarded():
            self._library = self._make()

    def _make(self) -> Any:
        """The framework's optimizer."""
        raise NotImplementedError

    def _ask_one(self) -> tuple[Float64, Any]:
        """A point (d,) and what the framework calls it."""
        raise NotImplementedError

    def _tell_one(self, candidate: Any, loss: float) -> None:
        raise NotImplementedError

    def _sample(self) -> Float64:
        X = np.empty((self.popsize, self.dim))
        with self._guarded():
            for i in range(self.popsize):
                x, candidate = self._ask_one()
                X[i] = np.clip(x, 0.0, 1.0)
                self._candidates.setdefault(X[i].tobytes(), []).append(candidate)
        return X

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        with self._guarded():
            for x, loss in zip(X, losses.tolist(), strict=True):
                several = self._candidates[x.tobytes()]
                self._tell_one(several.pop(0), self._penalty(loss))
                if not several:
                    del self._candidates[x.tobytes()]

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """While the framework is at work; what it raises is said to be its own."""
        with self._global_random.lent(), quietly():
            try:
                yield
            except Exception as error:
                package, _, method = self.name.partition(":")
                raise OptimizerError(
                    f"{self.name} failed after {self.evaluations} evaluations, {self.dim} "
                    f"parameters and a budget of {self.budget}, by an error in {package} "
                    f"{version(package)}: {type(error).__name__}: {error}; use another "
                    f"optimizer than {method}, or another version of {package}"
                ) from error

    def _default_popsize(self) -> int:
        return 1

    def _own_settings(self) -> dict[str, Any]:
        return {"budget": self.budget}


class Nevergrad(Framework):
    """An optimizer of `nevergrad.optimizers.registry`."""

    def _make(self) -> Any:
        import nevergrad

        center = nevergrad.p.Array(init=np.full(self.dim, 0.5), lower=0.0, upper=1.0)
        bits = np.random.MT19937(np.random.SeedSequence(self.seed))
        center.random_state = np.random.RandomState(bits)
        make = nevergrad.optimizers.registry[self.method]
        return make(center, budget=self.budget, num_workers=self.popsize)

    def _ask_one(self) -> tuple[Float64, Any]:
        candidate = self._library.ask()
        return candidate.value, candidate

    def _tell_one(self, candidate: Any, loss: float) -> None:
        self._library.tell(candidate, loss)

    def recommend(self) -> Float64:
        """What the framework recommends, (dim,)."""
        if self._best is None:
            return super().recommend()
        with self._guarded():
            point: Float64 = np.clip(self._library.provide_recommendation().value, 0.0, 1.0)
        return point


class Optuna(Framework):
    """A sampler of `optuna.samplers`; its first point is the center of the box."""

    def _make(self) -> Any:
        import optuna

        kinds = optuna.distributions
        self._space = {f"x{i}": kinds.FloatDistribution(0.0, 1.0) for i in range(self.dim)}
        sampler = getattr(optuna.samplers, self.method)
        seed = int(np.random.SeedSequence(self.seed).generate_state(1)[0])
        verbosity = optuna.logging.get_verbosity()
        optuna.logging.set_verbosity(optuna.logging.WARNING)  # it announces every study
        try:
            study = optuna.create_study(sampler=sampler(seed=seed))
        finally:
            optuna.logging.set_verbosity(verbosity)
        study.enqueue_trial(dict.fromkeys(self._space, 0.5))
        return study

    def _ask_one(self) -> tuple[Float64, Any]:
        trial = self._library.ask(self._space)
        return np.array([trial.params[name] for name in self._space]), trial

    def _tell_one(self, candidate: Any, loss: float) -> None:
        self._library.tell(candidate, loss)


def nevergrad(method: str) -> type[Nevergrad]:
    """Class of the optimizer `method` of Nevergrad, called "nevergrad:METHOD" here.

    Raises DependencyError (an ImportError) without Nevergrad, UnknownNameError for other names.
    """
    try:
        with quietly():
            from nevergrad import optimizers
    except ImportError as error:
        raise missing("nevergrad", f"nevergrad:{method} needs Nevergrad") from error
    if method not in optimizers.registry:
        raise UnknownNameError.of("optimizer of Nevergrad", method, optimizers.registry)
    return type("Nevergrad", (Nevergrad,), {"method": method, "name": f"nevergrad:{method}"})


def optuna(method: str) -> type[Optuna]:
    """Class of the sampler `method` of Optuna, called "optuna:METHOD" here.

    Raises DependencyError (an ImportError) without Optuna, UnknownNameError for other names.
    """
    try:
        from optuna import samplers
    except ImportError as error:
        raise missing("optuna", f"optuna:{method} needs Optuna") from error
    known = [name for name in samplers.__all__ if _takes_seed(getattr(samplers, name))]
    if method not in known:
        raise UnknownNameError.of("sampler of Optuna", method, known)
    return type("Optuna", (Optuna,), {"method": method, "name": f"optuna:{method}"})


def _takes_seed(thing: Any) -> bool:
    """Whether it is a sampler that can be made with a seed and nothing else."""
    import inspect

    if not isinstance(thing, type) or thing.__name__ in ("BaseSampler", "GridSampler"):
        return False
    parameters = inspect.signature(thing).parameters.values()
    needed = [p.name for p in parameters if p.default is p.empty and p.kind < p.VAR_POSITIONAL]
    return not needed and "seed" in inspect.signature(thing).parameters
