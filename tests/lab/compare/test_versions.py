"""A file, a model, weights or a loss that are others at the next call: results are not mixed."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fide_lab import compare, run as harness
from fide_lab.compare import Plan
from fide_lab.compare.driver import prepare
from fide_plugins import encoders, losses
from fide_plugins.encoders.patch import RawPatchEncoder
from fide_plugins.errors import CheckpointError
from fide_plugins.learning import learn
from fide_plugins.losses.base import MeanSquaredError
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.renderers import FunctionRenderer

from .conftest import contents, small

MINE = """
import numpy as np
LEAST = {least}

class Search:
    popsize = 10
    def __init__(self, dim, seed=None, fails=False):
        self.rng = np.random.default_rng(seed)
        self.dim, self.fails = dim, fails
    def ask(self, n):
        if self.fails and not LEAST:
            raise ArithmeticError("mend me")
        return self.rng.uniform(LEAST, 1, (n, self.dim))
    def tell(self, X, losses): ...
"""
SCENE = """
import numpy as np
space = 2
def render(x):
    return np.full((8, 8), {dark} * x.mean())
"""


class Mine(MeanSquaredError):
    """A loss that becomes another one."""

    name, version = "mine", "mine-1"


class Tiny(RawPatchEncoder):
    """An encoder as if it had pretrained weights."""

    name, weights_digest, version = "tiny", "a1", "tiny-1-a1"


def write(path: Path, text: str) -> None:
    """Write a module, as if the next process were to load it."""
    path.write_text(text)
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) == str(path):
            del sys.modules[name]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two models of the scene; the second as if it had been learned again."""
    where = tmp_path_factory.mktemp("models")
    (where / "scene.py").write_text(SCENE.format(dark=1.0))
    render = FunctionRenderer(f"{where / 'scene.py'}:render")
    model = learn(render, 2, renders=100, size=16, passes=1)
    first, again = where / "first.fide", where / "again.fide"
    model.save(first)
    replace(model, renderer="again").save(again)
    return first, again


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, models: tuple[Path, Path]) -> Path:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "mine.py", MINE.format(least=0.0))
    write(tmp_path / "scene.py", SCENE.format(dark=1.0))
    shutil.copy(models[0], tmp_path / "m.fide")
    for registry, made in ((losses._REGISTRY, Mine), (encoders._REGISTRY, Tiny)):
        factories: Any = registry._factories
        monkeypatch.setattr(registry, "_factories", {**factories, made.name: made})
    return tmp_path


@pytest.fixture
def change(
    folder: Path, models: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], None]:
    """Puts another version in the place of what is named."""

    def put(what: str) -> None:
        if what == "mine.py":
            write(folder / what, MINE.format(least=0.5) + "# longer: Python caches by size\n")
        elif what == "m.fide":
            shutil.copy(models[1], folder / what)
        elif what == "loss=mine":
            monkeypatch.setattr(Mine, "version", "mine-2")
        else:
            monkeypatch.setattr(Tiny, "weights_digest", "b2")
            monkeypatch.setattr(Tiny, "version", "tiny-1-b2")

    return put


def plan(*optimizers: str, **changes: Any) -> Plan:
    settings: dict[str, Any] = {"seeds": 1, "budget": 20, "losses": ("mse",), **changes}
    return small(*optimizers, tasks=("scene.py:render",), task_options={}, **settings)


PLANS = {
    "mine.py": (plan("mine.py:Search", "random"), "mine.py:Search"),
    "m.fide": (plan("fide:learned=m.fide", "random"), "learned=m.fide"),
    "encoder=tiny": (plan("eki:encoder=tiny:popsize=20"), "encoder=tiny"),
    "loss=mine": (plan("cma", losses=("mine",)), "loss=mine"),
}


def kinds(plan: Plan, **more: Any) -> list[str]:
    return [outcome.kind for outcome in compare.run(plan, "out", **more)]


def sources(path: Path) -> Any:
    return json.loads((path / "run.json").read_text())["sources"]


@pytest.mark.parametrize("what", PLANS)
def test_seeds_of_two_versions_are_not_mixed(what: str, change: Callable[[str], None]) -> None:
    first, reference = PLANS[what]
    more = replace(first, seeds=2)
    kinds(first)
    assert kinds(first, resume=True) == ["kept"] * len(first.configurations)
    there = contents(Path("out"))
    change(what)
    with pytest.raises(RunDirectoryError) as refused:
        kinds(more, resume=True)
    said = f"{what} has changed since runs with {reference} in out were finished"
    for words in (said, "undo the change", "another directory", "delete"):
        assert words in str(refused.value)
    assert contents(Path("out")) == there
    shutil.rmtree(Path("out") / next(first.runs()).folder.parent)
    assert kinds(more, resume=True)[0] == "done", "what the message says is enough"
    folders = [Path("out") / key.folder for key in more.runs()]
    assert len({str(sources(path).get(reference)) for path in folders} - {"None"}) == 1


def test_an_undone_change_is_none(folder: Path, change: Callable[[str], None]) -> None:
    kinds(plan("mine.py:Search"))
    change("mine.py")
    write(folder / "mine.py", MINE.format(least=0.0))
    assert kinds(plan("mine.py:Search", seeds=2), resume=True) == ["kept", "done"]


def test_a_mended_optimizer_begins_its_failed_runs_again(change: Callable[[str], None]) -> None:
    failing = plan("mine.py:Search:fails=true", "random", seeds=2)
    assert kinds(failing) == ["failed", "done"] * 2
    change("mine.py")
    comparison = prepare(failing, "out", resume=True)
    states = [state for state in comparison.states.values() if state.kind == "outdated"]
    assert [state.why for state in states] == ["mine.py has changed since it was begun"] * 2
    outcomes = comparison.execute()
    assert [outcome.kind for outcome in outcomes] == ["done", "kept"] * 2
    assert outcomes[0].note == "repeated, because mine.py has changed since it was begun"


def test_an_unfinished_run_of_fide_with_another_loss_begins_again(
    change: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(run: harness.Run) -> None:
        raise ArithmeticError("nothing is judged")

    with monkeypatch.context() as patch:
        patch.setattr(harness.Run, "_judge", fail)
        assert kinds(plan("fide", losses=("mine",))) == ["failed"]
    change("loss=mine")
    assert kinds(plan("fide", losses=("mine",)), resume=True) == ["done"]


SETTINGS: dict[str, Any] = {"size": 16, "task_options": {"cells": 2}, "out": "out"}


@pytest.mark.parametrize(
    ("what", "name", "loss", "options", "message"),
    [
        ("loss=mine", "fide", "mine", {}, "values of the loss mine-1; the one here is mine-2"),
        ("", "fide", "mse", {"encoder": "tiny"}, "features of the encoder tiny-1-a1"),
        ("", "eki", "mse", {"encoder": "tiny"}, "features of the encoder tiny-1-a1"),
    ],
)
def test_a_run_of_another_version_is_not_continued(
    what: str, name: str, loss: str, options: Any, message: str, change: Callable[[str], None]
) -> None:
    harness.run("voronoi", name, loss, 20, 1, options=options, **SETTINGS)
    before = sources(Path("out"))
    change(what)
    with pytest.raises(CheckpointError, match=message):
        harness.run("voronoi", name, loss, 30, 1, options=options, resume=True, **SETTINGS)
    assert sources(Path("out")) == before


def test_a_run_goes_on_with_a_warning(change: Callable[[str], None]) -> None:
    """The optimizer has the losses that it was told, of both versions."""
    harness.run("voronoi", "cma", "mine", 20, 1, **SETTINGS)
    change("loss=mine")
    with pytest.warns(RuntimeWarning, match="loss=mine has changed since the run in out"):
        harness.run("voronoi", "cma", "mine", 30, 1, resume=True, **SETTINGS)
    assert sources(Path("out"))["loss=mine"] == ["version:mine-1", "version:mine-2"]
