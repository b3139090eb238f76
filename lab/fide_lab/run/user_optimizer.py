"""Any object with `ask` and `tell` as an optimizer of the run loop."""

from __future__ import annotations

import os
from typing import Any, Protocol, Self

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.runtime.registry import own_name
from fide_plugins.status import Status
from fide_plugins.types import Float64, Optimizer, Solution

__all__ = ["AskTell", "UserOptimizer", "complete"]


class AskTell(Protocol):
    """What a user's optimizer must have; `UserOptimizer` says what it may have besides."""

    def ask(self) -> Any:
        """Candidates (n, dim) in [0, 1], n >= 1."""

    def tell(self, X: Any, images: Any, losses: Any, /) -> object:
        """Take the images (n, H, W, 3) and losses (n,) of points (n, dim)."""


class UserOptimizer:
    """A user's optimizer with defaults for all of `types.Optimizer` that it does not have.

    Only `ask` and `tell` are required.  Defaults of the rest: `ask_ready` asks, `recommend` gives
    the best point told (before the first finite loss, the center),
    `times` is empty, `popsize` is 1, `name` is that of the class; `save` raises OptionError.
    `evaluations` and `best` are counted here.

    evaluations, best: of a run that goes on, before this object was made.  Where the samples per
        pixel rise (`least_spp`), the loss of `best` is that of its last render.

    Raises OptionError (a ValueError) for an object without `ask` or `tell`.
    """

    def __init__(
        self, optimizer: AskTell, dim: int, evaluations: int = 0, best: Solution | None = None
    ) -> None:
        self.name, self.dim = own_name(optimizer), dim
        for method in ("ask", "tell"):
            if not callable(getattr(optimizer, method, None)):
                raise OptionError(f"an optimizer needs a method {method}, and {self.name} has none")
        self.popsize: int = getattr(optimizer, "popsize", 1)
        self.evaluations, self.best = evaluations, best
        self._optimizer = optimizer

    @property
    def times(self) -> dict[str, float]:
        """Seconds spent so far in "encode", "train" and "search", as far as it says."""
        times: dict[str, float] = self._own("times", {})
        return times

    @property
    def status(self) -> Status | None:
        """What is known of the run, as far as it says: a `Status`, or anything else as a text."""
        status = self._own("status")
        return status if isinstance(status, Status | None) else Status("unknown", str(status))

    def ask(self, n: int | None = None) -> Any:
        """Candidates (n, dim), as many as it likes with n None."""
        return self._optimizer.ask() if n is None else self._optimizer.ask(n)  # type: ignore[call-arg]

    def ask_ready(self) -> Any:
        """As `ask`, unless the optimizer has one of its own."""
        return self._own("ask_ready", self._optimizer.ask)()

    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        """Report points (n, dim) with images and losses (n,)."""
        self._optimizer.tell(X, images, losses)
        for x, loss in zip(np.asarray(X), np.asarray(losses).tolist(), strict=True):
            if np.isfinite(loss) and (self.best is None or loss < self.best.loss):
                self.best = Solution(x.copy(), loss, self.evaluations)
            self.evaluations += 1

    def recommend(self) -> Float64:
        """Point (dim,) that it recommends."""
        return np.asarray(self._own("recommend", self._best_point)())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint; OptionError if it has no `save`."""
        self.check_saves()
        self._own("save")(path)

    def check_saves(self) -> None:
        """Raise OptionError unless it can be saved."""
        if not callable(self._own("save")):
            raise OptionError(
                f"{self.name} has no method save, which a run directory needs: give it save(path) "
                "and a class method load(path), or run without a directory"
            )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Raise OptionError: its own class loads it."""
        raise OptionError("a user's optimizer is loaded by its own class, then completed")

    def _own(self, name: str, default: Any = None) -> Any:
        return getattr(self._optimizer, name, default)

    def _best_point(self) -> Float64:
        return np.full(self.dim, 0.5) if self.best is None else self.best.x


def complete(
    optimizer: Any, dim: int, evaluations: int = 0, best: Solution | None = None
) -> Optimizer:
    """The optimizer itself if it has all of `types.Optimizer`, else a `UserOptimizer` of it."""
    if isinstance(optimizer, Optimizer):
        return optimizer
    return UserOptimizer(optimizer, dim, evaluations, best)
