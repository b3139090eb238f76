"""Losses that have another version at the next call of a comparison, or of a run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fide_lab import compare, run as harness
from fide_lab.compare.driver import prepare
from fide_plugins import losses
from fide_plugins.errors import CheckpointError
from fide_plugins.losses.mse import MeanSquaredError
from fide_plugins.recording.storage import RunDirectoryError

from .conftest import small


class Mine(MeanSquaredError):
    """A loss that becomes another one."""

    version = "mine-1"

    def __init__(self, target: object, variant: str = "usual") -> None:
        super().__init__(target)
        self.name = "mine" if variant == "usual" else f"mine:{variant}"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    factories = losses._REGISTRY._factories
    monkeypatch.setattr(losses._REGISTRY, "_factories", {**factories, "mine": Mine})


@pytest.fixture
def other(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda: monkeypatch.setattr(Mine, "version", "mine-2")


def kinds(plan: compare.Plan, **more: Any) -> list[str]:
    return [outcome.kind for outcome in compare.run(plan, "out", **more)]


def sources(path: Path) -> Any:
    return json.loads((path / "run.json").read_text())["sources"]


def test_each_run_has_the_versions_of_its_losses() -> None:
    plan = small("cma", seeds=1, losses=("mine", "perceptual"), metrics=("mse",))
    compare.run(plan, "out")
    found = {key.loss: sources(Path("out", key.folder)) for key in plan.runs()}
    mse = {"loss=mse": [f"version:{MeanSquaredError.version}"]}
    assert found["mine"] == {"loss=mine": ["version:mine-1"], **mse}
    assert found["perceptual"].keys() == {"loss=perceptual", "loss=mse"}


@pytest.mark.parametrize(
    ("plan", "folder_named"),
    [
        (small("cma", seeds=1, losses=("mine", "mse"), metrics=()), "cells/*/mine"),
        (small("cma", seeds=1, losses=("mse",), metrics=("mine",)), "cells"),
    ],
)
def test_seeds_of_two_versions_are_not_mixed(plan: Any, folder_named: str, other: Any) -> None:
    kinds(plan)
    other()
    with pytest.warns(RuntimeWarning, match="the loss mine has changed since the runs with"):
        assert set(kinds(plan, resume=True)) == {"kept"}
    more = replace(plan, seeds=2)
    with pytest.raises(RunDirectoryError, match="the loss mine has changed since") as refused:
        kinds(more, resume=True)
    assert f"delete {Path('out') / folder_named} to do all of them again" in str(refused.value)
    for path in Path("out").glob(folder_named):
        shutil.rmtree(path)
    assert set(kinds(more, resume=True)) <= {"done", "kept"}


def test_the_usual_variant_may_be_named() -> None:
    """Its runs have the name without it, as `lpips:alex` is `lpips`."""
    plan = small("cma", seeds=1, losses=("mine:usual",))
    assert kinds(plan) == ["done"]
    assert kinds(replace(plan, seeds=2), resume=True) == ["kept", "done"]
    assert [run.state for run in compare.read("out").runs] == ["finished"] * 2


def test_the_report_says_that_a_loss_changed_between_its_runs(other: Any) -> None:
    prepare(small("cma", losses=("mine",)), "out").execute(lambda outcome: other())
    with pytest.warns(RuntimeWarning, match="the loss mine has changed while runs with loss=mine"):
        compare.read("out")


def test_an_unfinished_run_of_another_version_begins_anew(
    other: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of FIDE, too, which refuses losses of another version."""
    plan = small("fide", "cma", seeds=1, losses=("mine",))

    def fail(run: harness.Run) -> None:
        raise ArithmeticError("nothing is judged")

    with monkeypatch.context() as patch:
        patch.setattr(harness.Run, "_judge", fail)
        assert kinds(plan) == ["failed"] * 2
    other()
    assert kinds(plan, resume=True) == ["done"] * 2
    for key in plan.runs():
        assert sources(Path("out", key.folder))["loss=mine"] == ["version:mine-2"]


SETTINGS: dict[str, Any] = {"size": 16, "task_options": {"cells": 2}, "out": "out"}


def test_a_run_goes_on_with_a_warning(other: Any) -> None:
    """The optimizer has the losses that it was told, of both versions."""
    harness.run("voronoi", "cma", "mine", 20, 1, **SETTINGS)
    other()
    with pytest.warns(RuntimeWarning, match="the loss mine has changed since the run in out"):
        harness.run("voronoi", "cma", "mine", 30, 1, resume=True, **SETTINGS)
    assert sources(Path("out"))["loss=mine"] == ["version:mine-1", "version:mine-2"]
    harness.run("voronoi", "cma", "mine", 40, 1, resume=True, **SETTINGS)


def test_fide_does_not_go_on(other: Any) -> None:
    harness.run("voronoi", "fide", "mine", 20, 1, **SETTINGS)
    before = sources(Path("out"))
    other()
    with pytest.raises(CheckpointError, match="values of the loss mine-1; the one here is mine-2"):
        harness.run("voronoi", "fide", "mine", 30, 1, resume=True, **SETTINGS)
    assert sources(Path("out")) == before
