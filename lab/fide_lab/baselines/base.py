"""What all baselines share: ask and tell, generations, the best point, saving.

A baseline says how it draws candidates (`_sample`), what it learns from a complete generation
(`_update`), and where its search stands (`recommend`).

*Generations* are kept by `fide_plugins.population`, as FIDE's are: a generation is complete as soon
as `popsize` pending candidates are evaluated, in whatever order and pieces.  `_update` receives
the candidates exactly as they were drawn, in the order in which they were asked.

*Injected candidates* were never asked, were told before, or were asked before a restart.  They are
counted and can become `best`; they do not move the search.

*Losses that are NaN or infinite* are counted, rank last, and never become `best`.

A baseline is saved in one of two ways: `replay.Replayed` runs it again, `stateful.Stateful` stores
what it knows.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from fide_plugins import losses as losses_module
from fide_plugins.errors import LossError
from fide_plugins.losses.base import as_losses
from fide_plugins.population import Candidate, Population
from fide_plugins.runtime.machine import timed
from fide_plugins.runtime.schema import Schema, Sides, anything, array, check, maybe, real, whole
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread
from fide_plugins.saving import Saved
from fide_plugins.search.cma_es import default_popsize
from fide_plugins.types import Float32, Float64, Solution
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.options import positive
from fide_plugins.validation.points import as_points, new_seed, whole_number

__all__ = ["Baseline"]


class Baseline(Saved):
    """An optimizer over [0, 1]^dim.

    dim: number of parameters.
    target: image to fit; needed only where `tell` is to compute losses from images.
    loss: name, callable, or None for "mse"; see `fide_plugins.losses`.
    popsize: candidates a generation; None: the baseline's own default.
    sigma0: initial standard deviation, for those that have one.
    seed: same seed, same run; None draws one.
    device: of a named loss and of an encoder; "auto" takes CUDA where there is some for those that
        are networks.

    Any number of threads may ask and tell the same baseline.

    Raises OptionError (a ValueError) for options out of range, ImageError for a bad target,
    DeviceError for a device that this machine does not have.
    """

    training = False
    """No baseline trains in the background."""
    status = None
    """No baseline says how its run is going, as `FIDE.status` does."""

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        loss: str | Callable[..., object] | None = None,
        popsize: int | None = None,
        sigma0: float = 1 / 6,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        self.dim = whole_number("dim", dim, 1)
        if popsize is not None:
            popsize = whole_number("popsize", popsize, self._smallest_popsize())
        self.popsize = self._default_popsize() if popsize is None else popsize
        self.sigma0 = positive("sigma0", sigma0)
        self.seed = new_seed(seed)
        self.device = _checked_device(device)
        self.target = None if target is None else as_target(target)
        self._loss = losses_module.resolve(loss, self.target, device=device)
        self.evaluations = 0
        self.times = {"encode": 0.0, "train": 0.0, "search": 0.0}  # seconds
        self._lock = Lock()
        self._best: Solution | None = None
        self._population = Population()
        self._told_features: dict[int, Float32] = {}  # (f,) each, of this generation, by candidate

    # -- ask and tell ------------------------------------------------------------------------------

    @property
    def best(self) -> Solution | None:
        """Best point told so far; None before the first with a finite loss."""
        return None if self._best is None else self._best.copy()

    @one_at_a_time
    @one_thread
    def ask(self, n: int | None = None) -> Float64:
        """Candidates, float64 (n, dim) in [0, 1]; None: what is left of the generation.

        If all of it is pending, another `popsize` candidates are drawn.
        """
        n = None if n is None else whole_number("n", n, 1)
        with self._timed("search"):
            return np.array([candidate.x for candidate in self._hand_out(n)])

    def ask_ready(self) -> Float64:
        """As `ask`: no candidate of a baseline waits for training."""
        return self.ask()

    @one_at_a_time
    @one_thread
    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        """Report results: points X (n, dim), and their losses (n,) or images to compute them of.

        A point that was asked may come back in single precision.  Everything is checked before
        anything changes.  Raises PointsError, ImageError or LossError (all ValueErrors).
        """
        points = as_points(X, self.dim)
        if images is None and losses is None:
            raise LossError("tell needs images, losses, or both; got neither")
        batch = self._as_batch(images, len(points))
        with self._timed("encode"):
            values = self._compute(batch) if losses is None else as_losses(losses, len(points))
            features = self._encode(batch)
        with self._timed("search"):
            for i, (x, loss) in enumerate(zip(points, values.tolist(), strict=True)):
                image = None if batch is None else batch[i]
                self._record(x, loss, image, None if features is None else features[i])

    def recommend(self) -> Float64:
        """Point (dim,) that the search believes in; by default the best, or the center."""
        return np.full(self.dim, 0.5) if self._best is None else self._best.x.copy()

    # -- for subclasses ----------------------------------------------------------------------------

    @abstractmethod
    def _sample(self) -> Float64:
        """Draw candidates, (popsize, dim) in [0, 1]."""

    @abstractmethod
    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        """Learn from a generation, (popsize, dim) and (popsize,); losses are finite or +inf.

        features: (popsize, f), what `_encode` made of its images.
        """

    def _encode(self, batch: Float32 | None) -> Float32 | None:
        """Features (n, f) of images (n, H, W, 3) that `_update` needs; None: it needs none."""
        return None

    def _own_settings(self) -> dict[str, Any]:
        """Arguments of the subclass's constructor, by name."""
        return {}

    @abstractmethod
    def _search_state(self) -> dict[str, Any]:
        """What the search knows, see `Saved.state_dict`."""

    @abstractmethod
    def _load_search_state(self, state: dict[str, Any]) -> None:
        """Put back what `_search_state` gave; ValueError if it is impossible."""

    def _sides(self) -> Sides:
        """Sides of the arrays in a saved state."""
        sides = {"d": self.dim, "k": self.popsize}
        if self.target is not None:
            sides["H"], sides["W"], _ = self.target.shape
        return sides

    def _default_popsize(self) -> int:
        """Hansen's 4 + 3 ln d, as that of FIDE."""
        return default_popsize(self.dim)

    def _smallest_popsize(self) -> int:
        return 1

    def _timed(self, part: str) -> AbstractContextManager[None]:
        return timed(self.times, part)

    # -- bookkeeping -------------------------------------------------------------------------------

    def _hand_out(self, n: int | None) -> list[Candidate]:
        """The next n candidates; None: those that remain of a generation."""
        population = self._population
        n = n or population.remaining or self.popsize
        population.expect(n)
        handed_out: list[Candidate] = []
        while len(handed_out) < n:
            if not population.remaining:
                X = self._sample()
                population.draw(X, X)
            handed_out.append(population.hand_out())
        return handed_out

    def _record(
        self, x: Float64, loss: float, image: Float32 | None, features: Float32 | None
    ) -> int | None:
        """Enter one result; finish the generation if that completes it.

        Returns the candidate's index, None if it is injected.
        """
        finite = bool(np.isfinite(loss))
        candidate = self._population.record(x, loss if finite else np.inf)
        index = None if candidate is None else candidate.index
        if index is not None and features is not None:
            self._told_features[index] = features
        if finite and (self._best is None or loss < self._best.loss):
            image = None if image is None else image.copy()
            self._best = Solution(x.copy(), loss, self.evaluations, image)
        self.evaluations += 1
        if self._population.complete:
            self._finish_generation()
        return index

    def _finish_generation(self) -> None:
        members, losses = self._population.close_generation()
        told, self._told_features = self._told_features, {}
        features = np.array([told[member.index] for member in members]) if told else None
        self._update(np.array([member.x for member in members]), losses, features)

    def _as_batch(self, images: object, n: int) -> Float32 | None:
        if images is None:
            return None
        return as_batch(images, None if self.target is None else self.target.shape, n=n)

    def _compute(self, batch: Float32 | None) -> Float64:
        if batch is None:
            raise LossError("a loss of images needs images; got none")
        return self._loss.compute(batch)

    # -- saving: see `saving.Saved` ---------------------------------------------------------------

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        common = {"dim": self.dim, "target": self.target, "popsize": self.popsize}
        return {**common, "sigma0": self.sigma0, "seed": self.seed, **self._own_settings()}

    @property
    def loss_name(self) -> str | None:
        """Name by which the loss can be made again; None for a user's own."""
        return self._loss.spec

    @one_at_a_time
    def state_dict(self) -> dict[str, Any]:
        """The best point, the counts, and what the search knows."""
        return {
            "evaluations": self.evaluations,
            "best": None if self._best is None else _pack(self._best),
            "times": dict(self.times),
            "search": self._search_state(),
        }

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called; ValueError if `state` is impossible."""
        check(state, _SCHEMA, self._sides())
        self._load_search_state(state["search"])
        self.evaluations, self.times = state["evaluations"], dict(state["times"])
        self._best = None if state["best"] is None else Solution(**state["best"])


def _pack(best: Solution) -> dict[str, Any]:
    return {name: getattr(best, name) for name in ("x", "loss", "evaluation", "image")}


def _checked_device(device: str) -> str:
    """The device's name; DeviceError unless this machine has it."""
    if device != "auto":
        from fide_plugins.runtime.devices import resolve_device  # PyTorch takes a second

        resolve_device(device)
    return device


_SCHEMA: Schema = {
    "evaluations": whole(),
    "best": maybe(
        {
            "x": array("d", low=0.0, high=1.0),
            "loss": real(),
            "evaluation": whole(),
            "image": maybe(array("H", "W", 3, low=0.0, high=1.0)),
        }
    ),
    "times": {"encode": real(), "train": real(), "search": real()},
    "search": anything,  # the subclass checks its own
}
