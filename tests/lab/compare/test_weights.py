"""Pretrained weights of an encoder that are others at the next call of a comparison."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from fide_lab import compare, run as harness
from fide_lab.compare import Plan
from fide_lab.compare.driver import prepare
from fide_plugins import encoders
from fide_plugins.encoders.patch import RawPatchEncoder
from fide_plugins.errors import CheckpointError
from fide_plugins.recording.storage import RunDirectoryError

from .conftest import contents, small

WITH = ("fide:encoder=tiny", "eki:encoder=tiny:popsize=20")


class Tiny(RawPatchEncoder):
    """An encoder as if it had pretrained weights."""

    name = "tiny"
    weights_digest = "a1"
    version = "tiny-1-a1"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    factories = encoders._REGISTRY._factories
    monkeypatch.setattr(encoders._REGISTRY, "_factories", {**factories, "tiny": Tiny})


@pytest.fixture
def other(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Puts other weights in the place of those."""

    def put(digest: str = "b2") -> None:
        monkeypatch.setattr(Tiny, "weights_digest", digest)
        monkeypatch.setattr(Tiny, "version", f"tiny-1-{digest}")

    return put


def kinds(plan: Plan, **more: Any) -> list[str]:
    return [outcome.kind for outcome in compare.run(plan, "out", **more)]


def weights() -> list[Any]:
    runs = [json.loads(file.read_text()) for file in Path("out").rglob("run.json")]
    return [run["sources"].get("encoder=tiny") for run in runs]


@pytest.mark.parametrize("one", WITH)
def test_seeds_of_two_weights_are_not_mixed(one: str, other: Any) -> None:
    kinds(small(one, "random", seeds=1))
    assert sorted(map(str, weights())) == ["None", "['weights:a1']"]
    there = contents(Path("out"))
    other()
    with pytest.raises(RunDirectoryError, match="the network of tiny has changed since") as refused:
        kinds(small(one, "random", seeds=2), resume=True)
    for words in ("runs with encoder=tiny in out were finished", "undo the change", "delete"):
        assert words in str(refused.value)
    assert contents(Path("out")) == there
    (runs,) = Path("out").glob(f"cells/*/*/{one.partition(':')[0]}+*")
    shutil.rmtree(runs)
    assert kinds(small(one, "random", seeds=2), resume=True) == ["done", "kept", "done", "done"]


@pytest.mark.parametrize("one", WITH)
def test_what_is_finished_is_reported_with_a_warning(one: str, other: Any) -> None:
    kinds(small(one))
    other()
    with pytest.warns(RuntimeWarning, match="the network of tiny has changed since the runs") as w:
        assert kinds(small(one), resume=True) == ["kept"] * 2
    assert len(w) == 1
    other("a1")
    assert kinds(small(one, seeds=3), resume=True) == ["kept", "kept", "done"]


def test_runs_whose_weights_nobody_has_recorded_go_on(other: Any) -> None:
    kinds(small(*WITH, seeds=1))
    for file in Path("out").rglob("run.json"):
        run = json.loads(file.read_text())
        del run["sources"]
        file.write_text(json.dumps(run))
    other()
    assert sorted(kinds(small(*WITH, seeds=2), resume=True)) == ["done"] * 2 + ["kept"] * 2


def test_the_report_says_that_weights_changed_between_its_runs(other: Any) -> None:
    prepare(small(WITH[0]), "out").execute(lambda outcome: other())
    with pytest.warns(RuntimeWarning, match="the network of tiny has changed while runs with"):
        compare.read("out")


@pytest.mark.parametrize("name", ["fide", "eki"])
def test_a_run_with_other_weights_is_not_continued(name: str, other: Any) -> None:
    """Its encoder refuses them, so there is no warning."""
    settings: dict[str, Any] = {"size": 16, "task_options": {"cells": 2}, "out": "out"}
    settings["options"] = {"encoder": "tiny"}
    harness.run("voronoi", name, "mse", 20, 1, **settings)
    other()
    with pytest.raises(CheckpointError, match="features of the encoder tiny-1-a1"):
        harness.run("voronoi", name, "mse", 30, 1, resume=True, **settings)
    assert weights() == [["weights:a1"]]
