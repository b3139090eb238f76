"""Optimizers of other packages: SciPy, DFO-LS, Nevergrad, Optuna.

A library that calls a function is driven by ask and tell (reverse communication).  It runs in a
thread of its own, which works only while the user's thread waits for it.  So the two never compute
at the same time, and results do not depend on timing.  The thread ends when the library returns,
when its `ReverseCommunication` is closed or garbage-collected, and when Python exits.
"""

from __future__ import annotations

import random
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from importlib.metadata import version
from queue import SimpleQueue
from typing import Any, ClassVar, TypeAlias

import numpy as np

from fide_lab.baselines.base import Baseline, ImageBased, Penalty, quietly
from fide_plugins.errors import OptimizerError, OptionError, ProtocolError, UnknownNameError
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import whole_number

Search: TypeAlias = Callable[[Callable[[Float64], Any]], None]
"""search(function) calls function(x) with points (d,), one after the other, until it is done."""


class _Cancelled(BaseException):
    """Raised in the library's thread, through it, to end it."""


def _work(search: Search, points: SimpleQueue[Any], answers: SimpleQueue[Any]) -> None:
    """All that the thread does; at the end there is None, or an error, in place of a point."""

    def evaluate(x: Float64) -> Any:
        points.put(np.array(x, np.float64))
        answer = answers.get()
        if isinstance(answer, _Cancelled):
            raise answer
        return answer

    try:
        search(evaluate)
        points.put(None)
    except _Cancelled:
        return
    except BaseException as error:
        points.put(error)


def _cancel(answers: SimpleQueue[Any], thread: threading.Thread) -> None:
    answers.put(_Cancelled())
    if thread is not threading.current_thread():
        thread.join()


class ReverseCommunication:
    """A search that waits at each point for its value.

    search: must not refer to this object, or its thread would keep it alive.
    around: entered whenever the search goes on, and left at its next point.
    over: whether the search is done.
    """

    def __init__(
        self, search: Search, around: Callable[[], AbstractContextManager[Any]] = nullcontext
    ) -> None:
        self._around = around
        self._points: SimpleQueue[Any] = SimpleQueue()
        self._answers: SimpleQueue[Any] = SimpleQueue()
        work = search, self._points, self._answers
        self._thread = threading.Thread(target=_work, args=work, daemon=True)
        self._end: weakref.finalize[..., Any] | None = None
        self._point: Float64 | None = None
        self._running = False  # whether the search works; still so after Ctrl-C in the meantime
        self.over = False

    def point(self) -> Float64 | None:
        """Point (d,) whose value the search waits for; None when it is over.

        Raises whatever the search raised.
        """
        if self._end is None:
            self._end = weakref.finalize(self, _cancel, self._answers, self._thread)
            self._go_on(self._thread.start)
        if self._running:  # Ctrl-C came while it was waited for
            self._go_on(lambda: None)
        return self._point

    def answer(self, value: Any) -> None:
        """Give the value at the point, and let the search go on to its next one."""
        if not self.over:
            self._go_on(lambda: self._answers.put(value))

    def _go_on(self, start: Callable[[], None]) -> None:
        with self._around():
            self._running = True
            start()
            point = self._points.get()
            self._running = False
            self._point = point if isinstance(point, np.ndarray) else None
            self.over = self._point is None
            if isinstance(point, BaseException):
                raise point


class Sequential(Baseline):
    """A library's search in a thread of its own, one evaluation at a time: its population is 1.

    When a search is over, the next one begins.  If more is asked before the results are told, the
    same point is given again; only its first result is used.
    """

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        if self.popsize != 1:
            warn_user(
                f"popsize={self.popsize} has no effect on {self.name}, which asks for one "
                "candidate at a time"
            )
            self.popsize = 1
        self.starts = 0  # searches begun so far
        self._penalty = Penalty()
        self._global_random = GlobalRandom(self.seed)
        self._library: ReverseCommunication | None = None

    def _search(self) -> Search:
        """The next search, of which `starts` were begun before; it must not refer to self."""
        raise NotImplementedError

    def _answer(self, loss: float, features: Float32 | None) -> Any:
        """What the library's function returns."""
        return self._penalty(loss)

    def _sample(self) -> Float64:
        """Point (1, dim) whose value the search waits for; begins a search if there is none."""
        for _ in range(2):  # a search that is over is followed by another, which has a point
            if self._library is None or self._library.over:
                self._library = ReverseCommunication(self._search(), self._global_random.lent)
                self.starts += 1
            point = self._library.point()
            if point is not None:
                return np.clip(point[None], 0.0, 1.0)
        raise ProtocolError(f"{self.name} ended without evaluating a point; start a new one")

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._population.forget_pending()
        if self._library is not None:
            answer = self._answer(float(losses[0]), None if features is None else features[0])
            self._library.answer(answer)

    def _default_popsize(self) -> int:
        return 1


class GlobalRandom:
    """States of both global generators, made from a seed, to be lent to a library."""

    def __init__(self, seed: int) -> None:
        self._python = random.Random(seed).getstate()
        bits = np.random.MT19937(np.random.SeedSequence(seed))
        self._numpy = np.random.RandomState(bits).get_state()

    @contextmanager
    def lent(self, silent: bool = True) -> Iterator[None]:
        """The library may draw; afterwards the user's own states are as they were.

        silent: whether its warnings are dropped.
        """
        users = random.getstate(), np.random.get_state()
        random.setstate(self._python)
        np.random.set_state(self._numpy)
        try:
            with quietly() if silent else nullcontext():
                yield
        finally:
            self._python, self._numpy = random.getstate(), np.random.get_state()
            random.setstate(users[0])
            np.random.set_state(users[1])


class DualAnnealing(Sequential):
    """`scipy.optimize.dual_annealing` by ask and tell; options of `Baseline`.

    Generalized simulated annealing (Tsallis and Stariolo 1996), which descends from its best points
    by L-BFGS-B; each evaluation of its finite differences counts.  Where SciPy would return,
    another search starts from a random point.

    step: of the finite differences; None: SciPy's own, 1e-8, by which an image of 32-bit numbers
        does not change.  `lab/reports/baselines.md` has both.

    `sigma0` is not used.  Raises OptionError.
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
        local = {} if self.step is None else {"minimizer_kwargs": descent(self.dim, self.step)}
        return partial(anneal, x0=x0, rng=self._rng, **local)


def anneal(function: Any, x0: Float64, rng: np.random.Generator, **options: Any) -> None:
    """One search of SciPy's in the unit box, from x0."""
    from scipy.optimize import dual_annealing  # takes a tenth of a second

    dual_annealing(function, [(0.0, 1.0)] * len(x0), x0=x0, rng=rng, **options)


def descent(dim: int, step: float | None) -> dict[str, Any]:
    """Arguments of `scipy.optimize.minimize` for the local search, as `dual_annealing` has them."""
    options = {"maxiter": min(max(6 * dim, 100), 1000)} | ({} if step is None else {"eps": step})
    return {"method": "L-BFGS-B", "bounds": [(0.0, 1.0)] * dim, "options": options}


LONGEST = 100_000  # evaluations of one search; DFO-LS makes a list of that length


class DFOLS(ImageBased, Sequential):
    """Least squares by DFO-LS from near the center of the box, then from random points.

    Cartis, Fiala, Marteau and Roberts (2019) fit a linear model of the residual vector, here the
    features of an image minus those of the target, within a trust region (Gauss-Newton without
    derivatives).  It is told that the function is noisy, because an image changes in steps where an
    edge passes a pixel: its radius shrinks slowly, and it restarts by itself.

    sigma0: standard deviation of the first start around the center, which can be a point of
        symmetry where the linear model is blind.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.
    radius: of the first trust region, at most 0.5.

    The loss only decides which point is `best`.  The other options are those of `ImageBased`.

    Raises also DependencyError (an ImportError) without DFO-LS, which is under the GPL: pip install
    DFO-LS.
    """

    name: ClassVar[str] = "dfols"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        channels: int | None = 3,
        radius: float = 0.1,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, channels=channels, **options)
        if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0 < radius <= 0.5:
            raise OptionError(f"radius must lie in (0, 0.5], not {radius!r}")
        try:
            import dfols  # noqa: F401
        except ImportError as error:
            raise missing("dfols", "dfols needs the package DFO-LS") from error
        self.radius = float(radius)
        self._rng = np.random.default_rng(self.seed)

    def _search(self) -> Search:
        near = 0.5 + self.sigma0 * self._rng.standard_normal(self.dim) if self.starts == 0 else None
        x0 = self._rng.random(self.dim) if near is None else np.clip(near, 0.0, 1.0)
        return partial(least_squares, x0=x0, radius=self.radius)

    def _answer(self, loss: float, features: Float32 | None) -> Float64:
        assert features is not None
        wrong = features.astype(np.float64) - self.target_features
        residuals: Float64 = wrong / np.sqrt(len(wrong))
        return residuals


def least_squares(function: Any, x0: Float64, radius: float) -> None:
    """One search of DFO-LS in the unit box, from x0, until it has converged."""
    import dfols

    dfols.solve(
        function, x0, bounds=(np.zeros(len(x0)), np.ones(len(x0))), rhobeg=radius, maxfun=LONGEST,
        objfun_has_noise=True, user_params={"restarts.use_restarts": True}, do_logging=False,
    )  # fmt: skip


class Framework(Baseline):
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
        with self._global_random.lent():
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

    Raises DependencyError (an ImportError) without the package, UnknownNameError for other names.
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
    """Class of the sampler `method` of Optuna, "optuna:METHOD" here; raises as `nevergrad`."""
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
