"""Baselines whose library evaluates one point after the other."""

from __future__ import annotations

from typing import Any

from fide_lab.baselines.called_back import CalledBack
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32, Float64

__all__ = ["Sequential"]


class Sequential(CalledBack):
    """A library's search, one evaluation at a time: its population is 1.

    Another popsize, which may be meant for all optimizers of a comparison, has no effect, and gets
    a warning.
    """

    def __init__(self, dim: int, target: object = None, **options: Any) -> None:
        super().__init__(dim, target, **options)
        if self.popsize != 1:
            warn_user(
                f"popsize={self.popsize} has no effect on {self.name}, which asks for one "
                "candidate at a time"
            )
            self.popsize = 1

    def _answer(self, loss: float, features: Float32 | None) -> Any:
        """What the library's function returns."""
        return self._penalty(loss)

    def _sample(self) -> Float64:
        return self._points()

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._go_on(self._answer(float(losses[0]), None if features is None else features[0]))

    def _default_popsize(self) -> int:
        return 1
