"""Optimizers and tasks that have only what they must have."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import pytest

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import CMA
from fide_lab.run.task import TaskInfo
from fide_lab.run.user_optimizer import UserOptimizer, complete
from fide_plugins.errors import OptionError
from fide_plugins.types import Float64

TARGET = np.full((4, 4, 3), 0.3, np.float32)


class Gray:
    """A task of three attributes: an image of the mean of its parameters."""

    dim, target = 2, TARGET

    def render(self, X: Float64, seed: Any = None) -> Any:
        return np.broadcast_to(X.mean(1)[:, None, None, None], (len(X), 4, 4, 3))


class Clean(Gray):
    """The same with a reference image."""

    def reference(self, x: Float64) -> Any:
        return self.render(x[None])[0]


class Least:
    """CMA-ES, of which no more than `ask` and `tell` is to be seen."""

    def __init__(self, dim: int, target: object, **options: Any) -> None:
        self._cma = CMA(dim, target, **options)

    def ask(self) -> Float64:
        return self._cma.ask()

    def tell(self, X: Any, images: Any, losses: Any) -> None:
        self._cma.tell(X, images, losses)


class Saving(Least):
    """The same, which can be saved."""

    def save(self, path: str | os.PathLike[str]) -> None:
        self._cma.save(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        loaded = cls(1, None)
        loaded._cma = CMA.load(path)
        return loaded


class Worse:
    """Asks for the answer in its first 20 candidates, and for others later."""

    def __init__(self, dim: int, target: object, told: int = 0, **_: Any) -> None:
        self.told = told

    def ask(self) -> Float64:
        return np.full((10, 2), 0.3 if self.told < 20 else 0.9)

    def tell(self, X: Any, images: Any, losses: Any) -> None:
        self.told += len(X)

    def save(self, path: str | os.PathLike[str]) -> None:
        Path(path).write_text(str(self.told))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        return cls(2, TARGET, int(Path(path).read_text()))


def test_ask_and_tell_are_enough() -> None:
    least = harness.run(Gray(), Least, budget=60, seed=3)
    whole = harness.run(Gray(), CMA, budget=60, seed=3)
    np.testing.assert_array_equal(least.losses, whole.losses)
    assert (least.task, least.optimizer) == ("Gray", "Least")
    assert least.reference_loss == least.best_loss
    assert least.times["train"] == 0.0 and least.times["search"] > 0.0


def test_defaults() -> None:
    opt = complete(Least(2, TARGET, seed=0), 2)
    assert isinstance(opt, UserOptimizer)
    assert (opt.popsize, opt.times, opt.best) == (1, {}, None)
    np.testing.assert_array_equal(opt.recommend(), [0.5, 0.5])
    X = opt.ask_ready()
    losses = np.arange(len(X), 0.0, -1.0)
    losses[-1] = np.nan
    opt.tell(X, Gray().render(X), losses)
    assert opt.best is not None and opt.best.evaluation == len(X) - 2 == opt.evaluations - 2
    np.testing.assert_array_equal(opt.recommend(), X[-2])


def test_a_whole_optimizer_is_left_as_it_is() -> None:
    for name in ("cma", "fide"):
        made = optimizers.make(name, 2, np.zeros((16, 16, 3)), seed=0)
        assert complete(made, 2) is made


def test_what_an_optimizer_lacks_is_named() -> None:
    class Deaf:
        def ask(self) -> Any: ...

    with pytest.raises(OptionError, match="needs a method tell, and Deaf has none"):
        harness.prepare(Gray(), lambda *_, **__: cast(Any, Deaf()))


@pytest.mark.parametrize("cls", [Least, Saving])
def test_a_run_directory_needs_save(
    cls: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(optimizers._REGISTRY._factories, "own", cls)
    settings: dict[str, Any] = {"optimizer": "own", "budget": 30, "out": tmp_path / "run"}
    if cls is Least:
        with pytest.raises(OptionError, match="Least has no method save"):
            harness.prepare(Gray(), **settings)
        assert not (tmp_path / "run").exists()
        return
    first = harness.run(Gray(), **settings)
    again = harness.run(Gray(), **settings, resume=True)
    np.testing.assert_array_equal(first.losses, again.losses)


def test_a_resumed_run_recommends_the_best_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(optimizers._REGISTRY._factories, "own", Worse)
    settings: dict[str, Any] = {"optimizer": "own", "out": tmp_path / "run"}
    harness.run(Clean(), budget=20, **settings)
    resumed = harness.run(Clean(), budget=40, resume=True, **settings)
    assert resumed.best_evaluation == 0
    np.testing.assert_array_equal(resumed.x_recommended, [0.3, 0.3])
    assert resumed.recommended_loss == resumed.reference_loss


def test_a_task_that_says_nothing_of_itself() -> None:
    assert TaskInfo.of(Gray()) == TaskInfo("Gray")


def test_a_task_that_says_all() -> None:
    class Scene(Gray):
        name, seed, incidental_options, renderer, spp = "scene", 4, ("workers",), "llvm", 16

        def reference(self, x: Float64) -> Any:
            return x

        def advice(self, loss: str) -> str | None:
            return f"no {loss} here"

    scene = Scene()
    said = TaskInfo.of(scene)
    reference, advice = scene.reference, scene.advice
    assert said == TaskInfo("scene", 4, reference, ("workers",), "llvm", 16, advice=advice)
    assert harness.prepare(scene, "random", budget=4).advice == "no mse here"
