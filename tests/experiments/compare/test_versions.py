"""A file of the user that is edited between two calls of a comparison."""

from __future__ import annotations

import json
import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from fide_plugins.experiments import compare
from fide_plugins.experiments.compare import Configuration, Plan
from fide_plugins.experiments.compare.driver import prepare
from fide_plugins.recording.directory import RunDirectoryError

MINE = """
import numpy as np
LEAST = {least}

class Search:
    popsize = 10
    def __init__(self, dim, seed=None, fails_at=99):
        self.rng = np.random.default_rng(seed)
        self.dim, self.seed, self.fails_at = dim, seed, fails_at
    def ask(self, n):
        if self.seed >= self.fails_at:
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


def write(path: Path, text: str) -> None:
    """Write a module, as if the next process were to load it."""
    path.write_text(text)
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) == str(path):
            del sys.modules[name]


def edit(path: Path, template: str = MINE, **values: object) -> None:
    write(path, template.format(**values))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    edit(tmp_path / "mine.py", least=0.0)
    edit(tmp_path / "scene.py", SCENE, dark=1.0)
    return tmp_path


def plan(*optimizers: str, task: str = "scene.py:render", **changes: Any) -> Plan:
    named = tuple(map(Configuration.parse, optimizers or ("mine.py:Search", "random")))
    settings: dict[str, Any] = {"seeds": 1, "budget": 20, **changes}
    return Plan((task,), named, **settings)


def kinds(outcomes: list[compare.Outcome]) -> list[str]:
    return [outcome.kind for outcome in outcomes]


def test_seeds_of_two_versions_are_not_mixed(folder: Path) -> None:
    compare.run(plan(), "out")
    edit(folder / "mine.py", least=0.5)
    with pytest.raises(RunDirectoryError) as refused:
        compare.run(plan(seeds=2), "out", resume=True)
    for words in ("mine.py has changed", "mine.py:Search", "undo", "another directory", "delete"):
        assert words in str(refused.value)
    assert str(Path("out/cells/*/*/mine.py+Search")) in str(refused.value)
    shutil.rmtree("out/cells/scene.py+render/mse/mine.py+Search")
    outcomes = compare.run(plan(seeds=2), "out", resume=True)
    assert kinds(outcomes) == ["done", "kept", "done", "done"], "what the message says is enough"


def test_what_is_finished_is_reported_with_a_warning(folder: Path) -> None:
    compare.run(plan(), "out")
    edit(folder / "mine.py", least=0.5)
    with pytest.warns(RuntimeWarning, match=r"mine\.py has changed .* earlier version") as found:
        outcomes = compare.run(plan(), "out", resume=True)
    assert kinds(outcomes) == ["kept", "kept"] and len(found) == 1
    with pytest.warns(RuntimeWarning, match=r"mine\.py has changed"):
        outcomes = compare.run(
            plan("mine.py:Search", "mine.py:Search:fails_at=9"), "out", resume=True
        )
    assert kinds(outcomes) == ["kept", "done"], "options of its own, so another optimizer"


def test_an_undone_change_is_none(folder: Path) -> None:
    compare.run(plan(), "out")
    edit(folder / "mine.py", least=0.5)
    edit(folder / "mine.py", least=0.0)
    assert kinds(compare.run(plan(seeds=2), "out", resume=True)) == ["kept", "kept", "done", "done"]


def test_a_mended_optimizer_begins_its_failed_runs_anew(folder: Path) -> None:
    everywhere = plan("mine.py:Search:fails_at=0", "random", seeds=2)
    assert kinds(compare.run(everywhere, "out")) == ["failed", "done", "failed", "done"]
    edit(folder / "mine.py", least=0.5)
    write(folder / "mine.py", (folder / "mine.py").read_text().replace("raise", "pass # raise"))
    comparison = prepare(everywhere, "out", resume=True)
    states = [state for state in comparison.states.values() if state.kind == "outdated"]
    assert [state.why for state in states] == ["mine.py has changed since it was begun"] * 2
    outcomes = comparison.execute()
    assert kinds(outcomes) == ["done", "kept", "done", "kept"]
    assert outcomes[0].note == "repeated, because mine.py has changed since it was begun"


def test_renders_of_two_versions_are_not_mixed(folder: Path, tmp_path: Path) -> None:
    from PIL import Image

    Image.new("L", (8, 8), 99).save("target.png")
    options = {"target": "target.png"}
    compare.run(plan("random", task_options=options), "out")
    edit(folder / "scene.py", SCENE, dark=0.5)
    with pytest.raises(
        RunDirectoryError, match=r"scene\.py has changed .* delete .*scene\.py\+rend"
    ):
        compare.run(plan("random", "cma", task_options=options), "out", resume=True)
    with pytest.warns(RuntimeWarning, match=r"scene\.py has changed"):
        compare.run(plan("random", task_options=options), "out", resume=True)


def test_a_comparison_of_an_earlier_version_goes_on(folder: Path) -> None:
    compare.run(plan(), "out")
    for file in Path("out").rglob("run.json"):
        run = json.loads(file.read_text())
        assert next(iter(run.pop("sources"))) == "scene.py:render"
        file.write_text(json.dumps(run))
    edit(folder / "mine.py", least=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        outcomes = compare.run(plan(seeds=2), "out", resume=True)
    assert kinds(outcomes) == ["kept", "kept", "done", "done"]


def test_a_run_that_another_process_executes_is_not_said_to_be_continued(folder: Path) -> None:
    from fide_plugins.runtime import files

    failing = plan("mine.py:Search:fails_at=0")
    compare.run(failing, "out")
    key = next(failing.runs())
    assert prepare(failing, "out", resume=True).states[key].kind == "started"
    with files.locked(Path("out") / key.folder / ".lock"):
        assert prepare(failing, "out", resume=True).states[key].kind == "busy"


def test_optimizers_and_tasks_of_ours_have_no_files(folder: Path) -> None:
    small = plan("cma", task="voronoi", size=16, task_options={"cells": 2})
    assert small.sources() == {}
    compare.run(small, "out")
    (file,) = Path("out").rglob("run.json")
    assert "sources" not in json.loads(file.read_text())
