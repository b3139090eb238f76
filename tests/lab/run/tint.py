"""The simplest renderer there is; it can be told to misbehave."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np

from fide_lab.run import RunResult
from fide_plugins.types import Float64

TARGET = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)


class Tint:
    """A plain color, the simplest renderer there is; it can be told to misbehave."""

    name, dim, seed, target = "tint", 3, 5, TARGET

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.calls = 0
        self.at_call: dict[int, Any] = {}

    def render(self, X: Float64, seed: Any = None) -> Any:
        self.calls += 1
        self.seeds += seed
        if self.calls in self.at_call:
            self.at_call[self.calls]()
        return np.broadcast_to(X[:, None, None, :], (len(X), 6, 8, 3)).astype(np.float32)


class NoisyTint(Tint):
    def render(self, X: Float64, seed: Any = None) -> Any:
        images = super().render(X, seed)
        noise = [np.random.default_rng(s).normal(0, 0.02, (6, 8, 3)) for s in seed]
        return np.clip(images + noise, 0, 1).astype(np.float32)

    def reference(self, x: Float64) -> Any:
        return np.broadcast_to(x, (6, 8, 3))


def raise_interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def same(a: RunResult, b: RunResult) -> bool:
    assert a.x_best is not None and b.x_best is not None
    return (
        a.losses.tobytes() == b.losses.tobytes()
        and a.x_best.tobytes() == b.x_best.tobytes()
        and (a.best_loss, a.best_evaluation, a.mse) == (b.best_loss, b.best_evaluation, b.mse)
    )
