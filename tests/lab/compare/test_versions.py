"""A file of the user that is edited between two calls of a comparison."""

from __future__ import annotations

import json
import os
import shutil
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fide_lab import compare
from fide_lab.compare import Configuration, Plan
from fide_lab.compare.driver import prepare
from fide_lab.compare.plan import as_file_name
from fide_plugins.cli import main
from fide_plugins.learning import learn
from fide_plugins.recording.storage import RunDirectoryError
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.runtime.registry import of_file

from .conftest import contents

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
    assert set(json.loads(file.read_text())["sources"]) == {"loss=mse"}


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


@pytest.fixture
def model(folder: Path, models: tuple[Path, Path]) -> Path:
    """File of the first model, where it is used."""
    return Path(shutil.copy(models[0], folder / "m.fide"))


NAMED = ("learned=m.fide",)


@pytest.mark.parametrize("named", NAMED)
@pytest.mark.parametrize("of_all", [False, True])
def test_seeds_of_two_models_are_not_mixed(
    named: str, of_all: bool, model: Path, models: tuple[Path, Path]
) -> None:
    option, _, value = named.partition("=")
    common = {option: value} if of_all else {}
    names = ("fide",) if of_all else (f"fide:{named}", "random")

    def run(seeds: int, **more: bool) -> list[str]:
        return kinds(compare.run(plan(*names, seeds=seeds, options=common), "out", **more))

    run(1)
    there = contents(Path("out"))
    shutil.copy(models[1], model)
    with pytest.raises(RunDirectoryError) as refused:
        run(2, resume=True)
    for words in ("m.fide has changed", f"with {named} ", "undo", "another directory", "delete"):
        assert words in str(refused.value)
    assert contents(Path("out")) == there
    pattern = f"cells/*/*/{as_file_name(names[0])}"
    assert str(Path("out") / pattern) in str(refused.value)
    (runs,) = Path("out").glob(pattern)
    shutil.rmtree(runs)
    assert run(2, resume=True)[0] == "done", "what the message says is enough"


@pytest.mark.usefixtures("model")
@pytest.mark.parametrize("named", NAMED)
def test_runs_of_a_model_that_was_learned_again_are_reported_with_a_warning(
    named: str, models: tuple[Path, Path]
) -> None:
    finished = plan(f"fide:{named}")
    compare.run(finished, "out")
    shutil.copy(models[1], "m.fide")
    with pytest.warns(RuntimeWarning, match=r"m\.fide has changed .* earlier version") as found:
        assert kinds(compare.run(finished, "out", resume=True)) == ["kept"]
    assert len(found) == 1


def test_the_same_model_is_none_that_changed(model: Path) -> None:
    one = "fide:learned=m.fide"
    compare.run(plan(one), "out")
    content = model.read_bytes()
    model.unlink()
    model.write_bytes(content)
    os.utime(model, (0, 0))
    assert kinds(compare.run(plan(one, seeds=2), "out", resume=True)) == ["kept", "done"]
    runs = [json.loads(file.read_text()) for file in Path("out").rglob("run.json")]
    assert runs[0]["sources"] == runs[1]["sources"]
    assert set(NAMED) < set(runs[0]["sources"])


def test_runs_whose_models_nobody_has_recorded_go_on(
    model: Path, models: tuple[Path, Path]
) -> None:
    compare.run(plan("fide:learned=m.fide"), "out")
    (file,) = Path("out").rglob("run.json")
    run = json.loads(file.read_text())
    del run["sources"]["learned=m.fide"]
    file.write_text(json.dumps(run))
    shutil.copy(models[1], model)
    outcomes = compare.run(plan("fide:learned=m.fide", seeds=2), "out", resume=True)
    assert kinds(outcomes) == ["kept", "done"]


def test_an_unfinished_run_of_a_model_that_was_learned_again_begins_anew(
    model: Path, models: tuple[Path, Path]
) -> None:
    one = plan("fide:learned=m.fide")
    compare.run(one, "out")
    (file,) = Path("out").rglob("run.json")
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": "interrupted"}))
    shutil.copy(models[1], model)
    (outcome,) = compare.run(one, "out", resume=True)
    assert outcome.kind == "done"
    assert outcome.note == "repeated, because m.fide has changed since it was begun"
    assert json.loads(file.read_text())["sources"]["learned=m.fide"] == [of_file(models[1])]


@pytest.mark.filterwarnings("always:m.fide has changed while:RuntimeWarning")
def test_the_report_says_that_a_file_changed_between_its_runs(
    model: Path, models: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    both = plan("fide:learned=m.fide", "fide", seeds=2)

    def learn_again(outcome: compare.Outcome) -> None:
        shutil.copy(models[1], model)

    prepare(both, "out").execute(learn_again)
    words = r"m\.fide has changed while runs with learned=m\.fide in out .*fide\+learned=m\.fide"
    with pytest.warns(RuntimeWarning, match=words) as found:
        compare.read("out")
    assert len(found) == 1
    assert main(["report", "out"]) == 0
    assert "fide report: m.fide has changed while runs" in capsys.readouterr().err
