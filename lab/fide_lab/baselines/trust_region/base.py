"""What both have in common: the design of a start, the data since then, the trust region."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.penalty import quietly
from fide_lab.baselines.stateful import Stateful
from fide_lab.baselines.trust_region.region import FIRST, REGION, SMALLEST, Region, candidates
from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.schema import GENERATOR, Schema, array, maybe, whole
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import whole_number

__all__ = ["Surrogate", "TrustRegion"]

MOST_CANDIDATES = 5000


class Surrogate(ABC):
    """Gaussian processes that were fitted to points and what was evaluated there."""

    lengthscales: Tensor
    """(d,)."""

    @abstractmethod
    def choose(self, points: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Of points (c, d), those (n, d) that are best in n draws of the processes."""


class TrustRegion(Stateful):
    """Bayesian optimization in a trust region.

    popsize: points a round; None: 4; `composite-bo` with 10 and 20 was weaker.
    initial: points of a Latin hypercube at every start; None: 2 d.  The very first is the center.
    candidates: points that are drawn from each round; None: 100 d, but at most 5,000.
    steps: of L-BFGS, by which the processes are fitted.
    smallest: side of the region, in (0, 0.8), below which a new search begins.  0.5**7 is
        that of the authors' program; a smaller side finds more digits and fewer basins.

    The other options are those of `Baseline`; `sigma0` is not used.

    Raises OptionError (a ValueError), and DependencyError (an ImportError) without BoTorch.
    """

    own_schema: ClassVar[dict[str, Schema]] = {
        "X": array("b", "d", low=0.0, high=1.0),
        "outputs": array("b", "o"),
        "values": array("b"),
        "design": array("w", "d", low=0.0, high=1.0),
        "waiting": maybe(array("k", "d", low=0.0, high=1.0)),
        "region": REGION,
        "starts": whole(),
        "rng": GENERATOR,
    }

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        initial: int | None = None,
        candidates: int | None = None,
        steps: int = 50,
        smallest: float = SMALLEST,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        _import(self.name)
        self.initial = whole_number("initial", 2 * self.dim if initial is None else initial, 2)
        most = min(100 * self.dim, MOST_CANDIDATES) if candidates is None else candidates
        self.candidates = whole_number("candidates", most, 2)
        self.steps = whole_number("steps", steps, 1)
        self.smallest = positive("smallest", smallest)
        if self.smallest >= FIRST:
            raise OptionError(
                f"smallest must be less than {FIRST}, the first side of the region, not {smallest}"
            )
        self._rng = np.random.default_rng(self.seed)
        self.starts = 0  # searches begun so far
        self._start()

    @abstractmethod
    def _outputs(self, losses: Float64, features: Float32 | None) -> tuple[Float64, Float64]:
        """What is modelled of points, (n, o), and the values that are minimized, (n,)."""

    @abstractmethod
    def _fit(self, X: Tensor, outputs: Tensor) -> Surrogate:
        """Processes fitted to points (n, d) and their outputs (n, o)."""

    def _start(self) -> None:
        self._X, self._values = np.empty((0, self.dim)), np.empty(0)
        self._results: Float64 | None = None  # outputs (n, o)
        self._waiting: Float64 | None = None  # points of this round
        self._region = Region()
        rounds = -(-self.initial // self.popsize)
        self._design = latin_hypercube(rounds * self.popsize, self.dim, self._rng)
        if self.starts == 0:
            self._design[0] = 0.5
        self.starts += 1

    def _sample(self) -> Float64:
        if self._waiting is None:
            if len(self._design) or len(self._values) < 2:
                self._waiting = self._next_of_design()
            else:
                with self._timed("train"):
                    self._waiting = self._propose()
        return self._waiting

    def _next_of_design(self) -> Float64:
        if not len(self._design):  # too many of it failed
            self._design = latin_hypercube(self.popsize, self.dim, self._rng)
        points, self._design = self._design[: self.popsize], self._design[self.popsize :]
        return points

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._population.forget_pending()  # if more was asked, they are the same points
        designed = len(self._values) < self.initial
        self._waiting = None
        outputs, values = self._outputs(losses, features)
        good = np.isfinite(values)
        before = float(np.min(self._values, initial=np.inf))
        kept = outputs[good] if self._results is None else np.r_[self._results, outputs[good]]
        self._X, self._values, self._results = (
            np.r_[self._X, X[good]],
            np.r_[self._values, values[good]],
            kept,
        )
        if not designed:
            now = float(np.min(values[good], initial=np.inf))
            self._region.judge(before, now, self.dim, self.popsize)
            if self._region.length < self.smallest:
                self._start()

    def _propose(self) -> Float64:
        """One round: points (popsize, d)."""
        seed = int(self._rng.integers(2**31))
        assert self._results is not None
        X, outputs = torch.from_numpy(self._X), torch.from_numpy(self._results)
        with quietly(), torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)  # the library draws from the global generator
            generator = torch.Generator().manual_seed(seed)
            surrogate = self._fit(X, outputs)
            best = X[int(self._values.argmin())]
            n = max(self.candidates, self.popsize)
            points = candidates(best, surrogate.lengthscales, self._region.length, n, generator)
            chosen = surrogate.choose(points, self.popsize, generator)
        proposed: Float64 = chosen.clamp(0.0, 1.0).numpy()
        return proposed

    def _default_popsize(self) -> int:
        return 4

    def _own_settings(self) -> dict[str, Any]:
        own = {
            "initial": self.initial,
            "candidates": self.candidates,
            "steps": self.steps,
            "smallest": self.smallest,
        }
        return {**super()._own_settings(), **own}

    def _own_state(self) -> dict[str, Any]:
        results = np.empty((0, 1)) if self._results is None else self._results
        return {
            "X": self._X,
            "outputs": results,
            "values": self._values,
            "design": self._design,
            "waiting": self._waiting,
            "region": self._region.as_dict(),
            "starts": self.starts,
            "rng": self._rng.bit_generator.state,
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self._X, self._values, self._design = state["X"], state["values"], state["design"]
        self._results = state["outputs"] if len(state["outputs"]) else None
        self._waiting, self._region = state["waiting"], Region(**state["region"])
        self.starts = state["starts"]
        self._rng.bit_generator.state = state["rng"]


def latin_hypercube(n: int, dim: int, rng: np.random.Generator) -> Float64:
    """Points (n, dim) in the unit cube, one in each of n slices of every parameter."""
    from scipy.stats import qmc  # takes a second

    points: Float64 = qmc.LatinHypercube(dim, rng=rng).random(n)
    return points


def _import(name: str) -> None:
    """Raise DependencyError (an ImportError) unless BoTorch is there."""
    try:
        with quietly():
            import botorch  # noqa: F401
    except ImportError as error:
        raise missing("botorch", f"{name} needs BoTorch") from error
