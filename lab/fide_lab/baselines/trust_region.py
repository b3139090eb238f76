"""Bayesian optimization in a trust region: of the loss (`TuRBO`) and of the image (`CompositeBO`).

Every round (Eriksson et al. 2019, "Scalable global optimization via local Bayesian optimization")

1. Gaussian processes are fitted to what was evaluated since the last start.
2. Candidates are Sobol points in a box around the best point, whose sides are proportional to the
   lengthscales of the processes; each candidate changes some 20 of the parameters.
3. Thompson sampling: the processes are drawn `popsize` times, jointly at all candidates, and the
   best candidate of each draw is evaluated.
4. The box doubles after three rounds with progress and halves after some without.  When it has
   become small, all is forgotten and the search begins anew.

The processes, the draws and the quasi-random points are those of BoTorch and GPyTorch.  TuRBO's are
its `SingleTaskGP` of the loss with a Matern-5/2 kernel, where the authors' program makes 50 steps
of Adam within narrow limits.

Composite optimization (Astudillo and Frazier 2019; for images Maddox et al. 2021) models the
principal components of the image's features, and computes the distance from the target of their
draws.  All components have one kernel, so that one Cholesky decomposition serves them all.  With K
(n, n) the correlation of the points and one noise for all, the variance of component y (n,) is its
most likely one, y^T K^-1 y / n, and the lengthscales and the noise minimize

    m log det K + n sum_j log (y_j^T K^-1 y_j / n) - 2 log prior(lengthscales).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import ceil
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from fide_lab.baselines.base import ImageBased, Stateful, quietly
from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import missing
from fide_plugins.runtime.schema import GENERATOR, Schema, array, maybe, real, whole
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import whole_number

FIRST, LARGEST = 0.8, 1.6  # side of the box, before the lengthscales
SMALLEST = 0.5**7  # that of the authors' program
SUCCESSES = 3  # rounds with progress in a row, after which it doubles
PROGRESS = 1e-3  # of the best value, which a round must at least bring
CHANGED = 20  # parameters of a candidate that differ from the best point's, on average


@dataclass
class Region:
    """Side of the box, and the rounds in a row with progress and without it."""

    length: float = FIRST
    successes: int = 0
    failures: int = 0

    def judge(self, before: float, now: float, dim: int, popsize: int) -> None:
        """Adapt the side to the best value `before` a round of `popsize` points, and in it."""
        if now < before - PROGRESS * abs(before):
            self.successes, self.failures = self.successes + 1, 0
        else:
            self.successes, self.failures = 0, self.failures + 1
        if self.successes == SUCCESSES:
            self.length, self.successes = min(2.0 * self.length, LARGEST), 0
        elif self.failures >= ceil(max(4.0, dim) / popsize):
            self.length, self.failures = self.length / 2.0, 0


REGION: Schema = {
    "length": real(0.0, LARGEST),
    "successes": whole(0, SUCCESSES),
    "failures": whole(),
}


def candidates(
    best: Tensor, lengthscales: Tensor, length: float, n: int, generator: torch.Generator
) -> Tensor:
    """Points (n, d) in the unit cube and in the box of that side around `best` (d,).

    lengthscales: (d,); the sides are proportional to them, and their product is length^d.
    """
    d = len(best)
    weights = lengthscales / lengthscales.log().mean().exp()
    low = (best - weights * length / 2).clamp(0.0, 1.0)
    high = (best + weights * length / 2).clamp(0.0, 1.0)
    seed = int(torch.randint(2**31, (), generator=generator))
    sobol = torch.quasirandom.SobolEngine(d, scramble=True, seed=seed)  # type: ignore[no-untyped-call]
    points: Tensor = low + (high - low) * sobol.draw(n, dtype=best.dtype)
    change = torch.rand(n, d, generator=generator) <= CHANGED / d
    at_least = torch.randint(d, (n,), generator=generator)
    change[torch.arange(n), at_least] |= ~change.any(dim=1)
    return torch.where(change, points, best)


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

    own_options: ClassVar[tuple[str, ...]] = ("initial", "candidates", "steps", "smallest")
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

    def _own_state(self) -> dict[str, Any]:
        results = np.empty((0, 1)) if self._results is None else self._results
        return {
            "X": self._X,
            "outputs": results,
            "values": self._values,
            "design": self._design,
            "waiting": self._waiting,
            "region": asdict(self._region),
            "starts": self.starts,
            **super()._own_state(),
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self._X, self._values, self._design = state["X"], state["values"], state["design"]
        self._results = state["outputs"] if len(state["outputs"]) else None
        self._waiting, self._region = state["waiting"], Region(**state["region"])
        self.starts = state["starts"]
        super()._load_own_state(state)


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


class TuRBO(TrustRegion):
    """Trust-region Bayesian optimization of the loss; extra `botorch`.

    popsize: points a round, 4.
    initial: points of a Latin hypercube at every start; None: 2 d.
    candidates: points that are drawn from each round; None: 100 d, but at most 5,000.
    steps: of L-BFGS, by which the process is fitted.
    smallest: side of the region, in (0, 0.8), below which a new search begins; 0.5**7.

    The other options are those of `Baseline`; `sigma0` is not used.

    Raises OptionError (a ValueError), and DependencyError (an ImportError) without BoTorch.
    """

    name: ClassVar[str] = "turbo"

    def _outputs(self, losses: Float64, features: Float32 | None) -> tuple[Float64, Float64]:
        return losses[:, None], losses

    def _fit(self, X: Tensor, outputs: Tensor) -> Surrogate:
        return LossModel(X, outputs, self.steps)


class LossModel(Surrogate):
    """BoTorch's process of losses (n, 1) at points (n, d)."""

    def __init__(self, X: Tensor, losses: Tensor, steps: int) -> None:
        from botorch.exceptions import ModelFittingError
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
        from gpytorch.mlls import ExactMarginalLogLikelihood

        kernel = get_covar_module_with_dim_scaled_prior(X.shape[1], use_rbf_kernel=False)
        self.model = SingleTaskGP(X, -losses, covar_module=kernel)
        likelihood = ExactMarginalLogLikelihood(self.model.likelihood, self.model)
        with suppress(ModelFittingError):  # it then goes on with the priors' modes
            fit_gpytorch_mll(likelihood, optimizer_kwargs={"options": {"maxiter": steps}})
        self.model.eval()
        self.lengthscales = kernel.lengthscale.detach()[0]

    def choose(self, points: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Of points (c, d), those (n, d) that are best in n draws."""
        from botorch.generation import MaxPosteriorSampling

        with torch.no_grad():
            chosen: Tensor = MaxPosteriorSampling(self.model, replacement=False)(points, n)
        return chosen


NOISE = (1e-8, 1e-1)  # least and largest variance of the noise, of the process's
FIRST_NOISE = 1e-4
JITTER = 1e-8
_NOTHING = 1e-30  # variance of components where all images so far are equal


class CompositeBO(ImageBased, TrustRegion):
    """Trust-region Bayesian optimization of the image; extra `botorch`.

    popsize, initial, candidates, steps: as of `TuRBO`.
    smallest: side of the region, in (0, 0.8), below which a new search begins.  That of `TuRBO`,
        0.5**7, ends searches in the right basin before they have found it.
    components: principal components that are modelled; fewer while there are fewer images.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.

    The search minimizes the distance of the features.  The loss decides only which point is `best`.
    The other options are those of `ImageBased` and `Baseline`; `sigma0` is not used.

    Raises OptionError, ImageError without a target (ValueErrors), and DependencyError (an
    ImportError) without BoTorch.
    """

    name: ClassVar[str] = "composite-bo"
    own_options = ("components",)

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        components: int = 24,
        channels: int | None = 3,
        smallest: float = 0.5**12,
        **options: Any,
    ) -> None:
        self.components = whole_number("components", components, 1)
        super().__init__(dim, target, channels=channels, smallest=smallest, **options)

    def _outputs(self, losses: Float64, features: Float32 | None) -> tuple[Float64, Float64]:
        assert features is not None
        wrong = features.astype(np.float64) - self.target_features  # (n, f)
        return wrong, np.square(wrong).mean(axis=1)

    def _fit(self, X: Tensor, outputs: Tensor) -> Surrogate:
        mean, scores = principal_components(outputs, self.components)
        return ImageModel(X, scores, mean, self.steps)


def principal_components(wrong: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Mean (m,) and scores (n, m) of differences (n, f), in the basis of their components.

    The squared norm of a difference is that of mean + scores, but for what is left out.
    """
    mean = wrong.mean(dim=0)
    _, singular, basis = torch.linalg.svd(wrong - mean, full_matrices=False)
    m = int((singular[:most] > 1e-9 * singular[0]).sum().clamp(min=1))
    basis = basis[:m]  # (m, f)
    return basis @ mean, (wrong - mean) @ basis.T


class ImageModel(Surrogate):
    """Processes of components Y (n, m) at points X (n, d); the aim is Y = -mean (m,)."""

    def __init__(self, X: Tensor, Y: Tensor, mean: Tensor, steps: int) -> None:
        from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior

        self._X, self._mean = X, mean
        self._kernel = get_covar_module_with_dim_scaled_prior(X.shape[1], use_rbf_kernel=False)
        self._kernel = self._kernel.to(X)
        self._log_noise = torch.nn.Parameter(X.new_tensor(FIRST_NOISE).log())
        self._learn(Y, steps)
        with torch.no_grad():
            self._root = self._decomposed()
            self._weights = torch.cholesky_solve(Y, self._root)  # K^-1 Y, (n, m)
            self._scales = ((Y * self._weights).sum(dim=0) / len(X)).sqrt()  # (m,)
        self.lengthscales = self._kernel.lengthscale.detach()[0]

    def posterior(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (c, m) at points (c, d), and correlation (c, c) of what is unknown there."""
        across = self._kernel(points, self._X).to_dense()  # (c, n)
        half = torch.linalg.solve_triangular(self._root, across.T, upper=False)  # (n, c)
        return across @ self._weights, self._kernel(points).to_dense() - half.T @ half

    def choose(self, points: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Of points (c, d), those (n, d) that are nearest to the target in n draws."""
        with torch.no_grad():
            mean, correlation = self.posterior(points)
            root = cholesky(correlation)
            free = torch.ones(len(points), dtype=torch.bool)
            chosen: list[int] = []
            for _ in range(n):
                normal = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
                drawn = self._mean + mean + (root @ normal) * self._scales  # (c, m)
                distance = drawn.square().sum(dim=1).where(free, torch.inf)
                chosen.append(int(distance.argmin()))
                free[chosen[-1]] = False
        return points[chosen]

    def _learn(self, Y: Tensor, steps: int) -> None:
        """Fit the lengthscales and the noise."""
        from botorch.optim.core import scipy_minimize

        lengthscale = self._kernel.raw_lengthscale  # is the lengthscale itself: no transform
        parameters = {"lengthscale": lengthscale, "noise": self._log_noise}
        limits = {"lengthscale": (2.5e-2, None), "noise": tuple(np.log(NOISE).tolist())}

        def closure() -> tuple[Tensor, list[Tensor]]:
            loss = self._loss(Y)
            return loss, list(torch.autograd.grad(loss, list(parameters.values())))

        scipy_minimize(closure, parameters, bounds=limits, options={"maxiter": steps})

    def _loss(self, Y: Tensor) -> Tensor:
        root = self._decomposed()
        white = torch.linalg.solve_triangular(root, Y, upper=False)  # (n, m)
        n, m = Y.shape
        fit = n * (white.square().sum(dim=0) / n).clamp_min(_NOTHING).log().sum()
        volume = 2 * m * root.diagonal().log().sum()
        prior = self._kernel.lengthscale_prior.log_prob(self._kernel.lengthscale).sum()
        loss: Tensor = (fit + volume - 2 * prior) / (n * m)
        return loss

    def _decomposed(self) -> Tensor:
        """Cholesky factor (n, n) of the correlation with its noise."""
        noise = self._log_noise.exp() * torch.eye(len(self._X), dtype=self._X.dtype)
        return cholesky(self._kernel(self._X).to_dense() + noise)


def cholesky(matrix: Tensor) -> Tensor:
    """Factor of a symmetric matrix, with more and more jitter if it is not quite positive."""
    eye = torch.eye(len(matrix), dtype=matrix.dtype)
    for power in range(8):
        root, failed = torch.linalg.cholesky_ex(matrix + JITTER * 10**power * eye)
        if not failed:
            break
    factor: Tensor = root
    return factor
