"""Optimizers and tasks that have only what they must have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import CMA
from fide_lab.run.task import TaskInfo
from fide_plugins.errors import OptionError
from fide_plugins.types import Float64

TARGET = np.full((4, 4, 3), 0.3, np.float32)


class Gray:
    """A task of three attributes: an image of the mean of its parameters."""

    dim, target = 2, TARGET

    def render(self, X: Float64, seed: Any = None) -> Any:
        return np.broadcast_to(X.mean(1)[:, None, None, None], (len(X), 4, 4, 3))


class Least:
    """CMA-ES, of which no more than `ask` and `tell` is to be seen."""

    popsize = 6

    def __init__(self, dim: int, seed: int | None = None) -> None:
        self._cma = CMA(dim, popsize=6, seed=seed)

    def ask(self, n: int) -> Float64:
        return self._cma.ask(n)

    def tell(self, X: Float64, losses: Float64) -> None:
        self._cma.tell(X, losses=losses)


def test_a_class_with_ask_and_tell_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    least = harness.run(Gray(), Least, budget=60, seed=3)
    whole = harness.run(Gray(), CMA, budget=60, seed=3, options={"popsize": 6})
    np.testing.assert_array_equal(least.losses, whole.losses)
    assert (least.task, least.optimizer) == ("Gray", "Least")
    assert least.reference_loss == least.best_loss
    monkeypatch.setitem(optimizers._REGISTRY._factories, "own", Least)
    for budget in (30, 30):
        harness.run(Gray(), "own", budget=budget, seed=3, out=tmp_path / "run", resume=True)


def test_what_an_optimizer_lacks_is_named() -> None:
    class Deaf:
        def __init__(self, dim: int) -> None: ...
        def ask(self, n: int) -> Any: ...

    with pytest.raises(OptionError, match="Deaf has no method tell"):
        harness.prepare(Gray(), Deaf)
    with pytest.raises(OptionError, match="made makes Least, which is no whole optimizer"):

        def made(dim: int, target: object, *, loss: Any, seed: int) -> Least:
            return Least(dim, seed)

        harness.prepare(Gray(), made)


def test_a_task_that_says_nothing_of_itself() -> None:
    assert TaskInfo.of(Gray()) == TaskInfo("Gray")


def test_a_task_that_says_all() -> None:
    class Scene(Gray):
        name, seed, incidental_options, renderer = "scene", 4, ("workers",), "llvm"

        def reference(self, x: Float64) -> Any:
            return x

    scene = Scene()
    said = TaskInfo.of(scene)
    assert said == TaskInfo("scene", 4, scene.reference, ("workers",), "llvm")
