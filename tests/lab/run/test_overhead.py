"""What the run loop costs beside the optimizer."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers, run as harness
from fide_plugins import losses
from fide_plugins.types import Float64

LIMIT_CALLS = 28  # for one render; 23 calls in November 2026


class Tint:
    name, dim, seed = "tint", 40, 0
    target = np.full((32, 32, 3), 0.25, np.float32)

    def render(self, X: Float64, seed: Any = None) -> Any:
        return np.broadcast_to(X[:, :3][:, None, None, :], (len(X), 32, 32, 3)).astype(np.float32)


def by_hand(budget: int) -> Callable[[], object]:
    """A run of CMA-ES by ask and tell, ready to start."""
    task, loss = Tint(), losses.resolve("mse", Tint.target)
    optimizer = optimizers.make("cma", task.dim, task.target, seed=0)

    def execute() -> None:
        while optimizer.evaluations < budget:
            X = optimizer.ask()[: budget - optimizer.evaluations]
            images = task.render(X)
            optimizer.tell(X, images, loss.compute(images))

    return execute


def by_the_harness(budget: int, out: Path) -> Callable[[], object]:
    """The same run, with record and folder; without checkpoints, which follow a clock."""
    keep = harness.Keep(("mse", "perceptual"), summary=False, checkpoint=False)
    run = harness.prepare(
        Tint(), "cma", "mse", budget, 0, out=out, keep=keep, checkpoint_every=math.inf
    )
    return run.execute


@pytest.mark.thorough
def test_the_loop_adds_few_calls_to_each_render(
    counted_calls: Callable[[Counter[str]], AbstractContextManager[None]], tmp_path: Path
) -> None:
    """Calls are counted, which no other program and no disk can change; begin and end left out."""

    def added(budget: int) -> int:
        count: Counter[str] = Counter()
        runs = by_hand(budget), by_the_harness(budget, tmp_path / str(budget))
        numbers = []
        for execute in runs:
            count.clear()
            with counted_calls(count):
                execute()
            numbers.append(count["calls"])
        return numbers[1] - numbers[0]

    added(100)  # what is done once in a process
    calls = (added(1800) - added(600)) / 1200
    assert calls < LIMIT_CALLS, f"the loop adds {calls:.1f} calls of functions to each render"
