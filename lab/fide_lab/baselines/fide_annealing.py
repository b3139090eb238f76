"""FIDE with dual annealing in the place of CMA-ES (supplement S4).

The search is SciPy's dual annealing, and of the points that it visits every second one is denoised
before it is rendered: the annealing accepts or rejects the point that was rendered, whichever kind
it is.  Points of both kinds are collected, and whenever there are k of them the denoiser is trained
on their images; their standard deviations, parameter by parameter, are then its noise model until
the next training.  The local search stays SciPy's.

Readings where the supplement is silent: nothing is denoised before the first training; evaluations
of the local search are not collected; each k points are used for one training.

How a point is replaced: SciPy calls the function with the very array that it keeps when the point
is accepted, so the function writes the denoised point there.  A test holds SciPy to that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fide_lab.baselines.dual_annealing import anneal, descent
from fide_lab.baselines.image_features import ImageBased
from fide_lab.baselines.reverse_communication import Search
from fide_lab.baselines.sequential import Sequential
from fide_plugins.runtime.schema import Schema, anything, array, check
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from fide_plugins.proposers.diffusion import DiffusionProposer

__all__ = ["FIDEAnnealing"]

SMALLEST_STD = 1e-8

_SCHEMA: Schema = {
    "history": anything,  # `Replayed` checks it
    "proposals": array("p", "d", low=0.0, high=1.0),
    "proposer": anything,  # checks its own
    "collected": array("n", "f"),
}


class Visits:
    """State shared by the annealing's thread and the optimizer; it refers to neither."""

    def __init__(self, denoise: Callable[[Float64, Float64], Float64]) -> None:
        self.denoise = denoise
        self.std: Float64 | None = None  # noise model, (d,); None before the first training
        self.count = 0
        self.descending = False  # whether the local search is at work
        self.proposals: list[Float64] = []  # all denoised points so far
        self.recorded: deque[Float64] = deque()  # those of a run that is replayed

    def replace(self, x: Float64) -> None:
        """Denoise every second of the points x (d,) that are visited, in place."""
        self.count += 1
        if self.std is None or self.count % 2:
            return
        proposal = self.recorded.popleft() if self.recorded else self.denoise(x, self.std)
        self.proposals.append(proposal)
        x[:] = proposal


class FIDEAnnealing(ImageBased, Sequential):
    """Dual annealing, half of whose points are denoised towards the target.

    samples: k, points before each training; 500 in the paper.
    epochs: of a training.
    encoder, channels: of the images, see `ImageBased`; the paper's simplest by default.
    step: of the finite differences of the local search; None: SciPy's own, 1e-8.

    The other options are those of `Baseline`; popsize is 1, and another one has no effect but a
    warning; `sigma0` is not used.

    Raises OptionError and ImageError without a target (ValueErrors).
    """

    name: ClassVar[str] = "fide-annealing"
    keeps_features: ClassVar[bool] = False  # the replay uses denoised points, not images

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        samples: int = 500,
        epochs: int = 12,
        encoder: str = "patch",
        step: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, encoder=encoder, **options)
        self.samples = whole_number("samples", samples, 2)
        self.epochs = whole_number("epochs", epochs, 1)
        self.step = None if step is None else positive("step", step)
        self._rng = np.random.default_rng(self.seed)
        from fide_plugins.proposers.diffusion import DiffusionProposer

        self._proposer = DiffusionProposer(self.dim, seed=self.seed, epochs=self.epochs)
        self._visits = Visits(partial(_denoise, self._proposer, self.target_tokens))
        self._x: list[Float64] = []  # collected since the last training
        self._features: list[Float32] = []  # of their images

    def _search(self) -> Search:
        x0 = np.full(self.dim, 0.5) if self.starts == 0 else self._rng.random(self.dim)
        return partial(_anneal, visits=self._visits, x0=x0, rng=self._rng, step=self.step)

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        if not self._visits.descending:
            self._collect(X[0], None if features is None else features[0])
        super()._update(X, losses, features)

    def _collect(self, x: Float64, features: Float32 | None) -> None:
        """Keep a visited point; features (f,) of its image, None in a replay."""
        self._x.append(x)
        if features is not None:
            self._features.append(features)
        if len(self._x) < self.samples:
            return
        points = np.array(self._x)
        self._visits.std = np.maximum(points.std(axis=0), SMALLEST_STD)
        if features is not None:
            with self._timed("train"):
                tokens = self.tokens_of(np.array(self._features))
                self._proposer.update(points, tokens, None, self._visits.std)
        self._x, self._features = [], []

    def _own_settings(self) -> dict[str, Any]:
        own = {"samples": self.samples, "epochs": self.epochs, "step": self.step}
        return {**super()._own_settings(), **own}

    def _search_state(self) -> dict[str, Any]:
        return {
            "history": super()._search_state(),
            "proposals": np.array(self._visits.proposals).reshape(-1, self.dim),
            "proposer": self._proposer.state_dict(),
            "collected": np.array(self._features, np.float32).reshape(-1, self._sides()["f"]),
        }

    def _load_search_state(self, state: dict[str, Any]) -> None:
        check(state, _SCHEMA, self._sides(), "search")
        self._visits.recorded.extend(state["proposals"])
        super()._load_search_state(state["history"])
        self._visits.recorded.clear()
        self._features = list(state["collected"])
        if len(self._features) != len(self._x):
            raise ValueError(f"features of {len(self._features)} points, not {len(self._x)}")
        self._proposer.load_state_dict(state["proposer"])


def _anneal(
    function: Any, visits: Visits, x0: Float64, rng: np.random.Generator, step: float | None
) -> None:
    """SciPy's search, which does not know that some of its points are replaced."""

    def energy(x: Float64) -> Any:
        if not visits.descending:
            visits.replace(x)
        return function(x)

    def descend(fun: Any, start: Float64, **_: Any) -> Any:
        from scipy.optimize import minimize

        visits.descending = True
        try:
            return minimize(fun, start, **descent(len(start), step))
        finally:
            visits.descending = False

    anneal(energy, x0, rng, minimizer_kwargs={"method": descend})


def _denoise(proposer: DiffusionProposer, target: Any, x: Float64, std: Float64) -> Float64:
    proposal: Float64 = np.clip(proposer.propose(x[None], target, x, std)[0], 0.0, 1.0)
    return proposal
