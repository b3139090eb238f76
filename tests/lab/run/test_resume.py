"""Interrupted runs go on to the same result; other runs and damaged directories are refused."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fide_lab import optimizers, run as harness
from fide_lab.baselines.evolution import Random
from fide_plugins.errors import (
    CheckpointError,
    OptionError,
    RenderError,
)
from fide_plugins.recording.storage import RunDirectoryError

from .tint import TARGET, NoisyTint, Tint, raise_interrupt, same


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> Callable[[type], str]:
    """Makes a class an optimizer by its name, which it returns."""

    def register(cls: type) -> str:
        monkeypatch.setitem(optimizers._REGISTRY._factories, cls.__name__.lower(), cls)
        return cls.__name__.lower()

    return register


def test_a_run_is_resumed_only_where_the_same_renderer_and_target_are(tmp_path: Path) -> None:
    class Parallel(Tint):
        incidental_options, renderer = ("workers",), "llvm"

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 5, "out": tmp_path}
    calm = {"workers": 1, "mood": "calm"}
    harness.run(Parallel(), **settings, task_options=calm)
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["renderer"] == "llvm"
    harness.run(Parallel(), **settings, task_options={**calm, "workers": 2}, resume=True)
    with pytest.raises(RunDirectoryError, match="other settings: task_options"):
        harness.run(Parallel(), **settings, task_options={"mood": "wild"}, resume=True)
    for name, value, message in (
        ("renderer", "scalar", "renderer is 'llvm' there and 'scalar' here"),
        ("target", TARGET[::-1], "other settings: the target is"),
    ):
        other = Parallel()
        setattr(other, name, value)
        with pytest.raises(RunDirectoryError, match=message):
            harness.run(other, **settings, task_options=calm, resume=True)


@pytest.mark.parametrize(
    ("optimizer", "call"), [("cma", 1), ("cma", 2), ("cma", 4), ("random", 1), ("random", 5)]
)
def test_resuming_after_ctrl_c_gives_the_uninterrupted_result(
    optimizer: str, call: int, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"budget": 230, "seed": 1, "options": {"popsize": 70}}
    whole = harness.run(NoisyTint(), optimizer, **settings)
    task = NoisyTint()
    task.at_call[call] = raise_interrupt
    with pytest.raises(harness.Interrupted) as caught:
        harness.run(task, optimizer, **settings, out=tmp_path)
    assert caught.value.signum == signal.SIGINT
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["state"] == "interrupted"
    assert run["totals"]["evaluations"] == [0, 32, 64, 70, 102][call - 1]
    resumed = harness.run(NoisyTint(), optimizer, **settings, out=tmp_path, resume=True)
    assert same(whole, resumed)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["state"] == "finished" and len(run["resumed"]) == 1
    assert len(list(tmp_path.glob("optimizer-*.ckpt"))) == 1
    task = NoisyTint()
    assert same(whole, harness.run(task, optimizer, **settings, out=tmp_path, resume=True))
    assert task.calls == 0  # it was finished


@pytest.mark.parametrize(("optimizer", "options"), [("fide", {}), ("cma", {"popsize": 70})])
@pytest.mark.parametrize("first", [3, 70, 100])
def test_a_larger_budget_goes_on_as_if_it_had_been_given_at_once(
    optimizer: str, options: dict[str, Any], first: int, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"optimizer": optimizer, "seed": 1, "options": options}
    whole = harness.run(NoisyTint(), **settings, budget=230)
    short = harness.run(NoisyTint(), **settings, budget=first, out=tmp_path)
    assert short.evaluations == first
    resumed = harness.run(NoisyTint(), **settings, budget=230, out=tmp_path, resume=True)
    assert same(whole, resumed)
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["budget"] == 230
    before = (tmp_path / "run.json").read_text()
    with pytest.raises(OptionError, match=f"has 230 renders already, and the budget is {first}"):
        harness.run(NoisyTint(), **settings, budget=first, out=tmp_path, resume=True)
    assert (tmp_path / "run.json").read_text() == before


def test_an_optimizer_that_depends_on_its_budget_refuses_another_one(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"optimizer": "inverse", "out": tmp_path, "options": {"epochs": 1}}
    harness.run(Tint(), **settings, budget=20)
    with pytest.raises(RunDirectoryError, match="other settings: budget is 20 there and 30 here"):
        harness.run(Tint(), **settings, budget=30, resume=True)


def test_a_kill_between_the_two_files_of_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fide_plugins.runtime import checkpoint

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 60, "options": {"popsize": 10}}
    write = checkpoint.write

    def killed(path: Any, kind: str, state: dict[str, Any]) -> None:
        # The render is interrupted right after a save, when a new generation has been asked:
        # the optimizer's file is written, and then the process dies.
        if kind == "run" and len(state["record"]["pending"]) > 0:
            raise OSError("killed")
        write(path, kind, state)

    task = Tint()
    task.at_call[3] = raise_interrupt
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", killed)
        with pytest.raises(OSError, match="killed"):
            harness.run(task, **settings, out=tmp_path, checkpoint_every=0.0)
    assert len(list(tmp_path.glob("optimizer-*.ckpt"))) == 2
    resumed = harness.run(Tint(), **settings, out=tmp_path, resume=True)
    assert same(resumed, harness.run(Tint(), **settings))


def test_a_signal_inside_the_optimizer_waits_for_the_step_to_end(
    known: Callable[[type], str], tmp_path: Path
) -> None:
    class Slow(Random):
        def tell(self, X: object, images: object = None, losses: object = None) -> None:
            if self.evaluations == 5:
                raise_interrupt()
                time.sleep(0.01)
            super().tell(X, images, losses)

    known(Slow)
    settings: dict[str, Any] = {"optimizer": "slow", "budget": 40, "options": {"popsize": 5}}
    with pytest.raises(harness.Interrupted):
        harness.run(Tint(), **settings, out=tmp_path)
    assert len((tmp_path / "curve.csv").read_text().splitlines()) == 1 + 10
    resumed = harness.run(Tint(), **settings, out=tmp_path, resume=True)
    assert same(resumed, harness.run(Tint(), "random", budget=40, options={"popsize": 5}))


@pytest.mark.skipif(os.name == "nt", reason="no such locks on Windows")
def test_a_second_process_is_refused_and_a_refused_one_holds_no_lock(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"optimizer": "cma", "budget": 60, "options": {"popsize": 10}}
    refused = []

    def again(progress: harness.Progress) -> None:
        before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
        with pytest.raises(RunDirectoryError, match="is under way, in another process"):
            harness.run(Tint(), **settings, out=tmp_path, resume=True)
        refused.append({p.name: p.read_bytes() for p in tmp_path.iterdir()} == before)

    harness.run(Tint(), **settings, out=tmp_path, on_progress=again)
    assert refused and all(refused)
    with pytest.raises(RunDirectoryError, match="already holds a run"):
        harness.run(Tint(), **settings, out=tmp_path)
    with pytest.raises(OptionError) as kept:  # with all that its traceback refers to
        harness.run(Tint(), **{**settings, "budget": 30}, out=tmp_path, resume=True)
    resumed = harness.run(Tint(), **{**settings, "budget": 80}, out=tmp_path, resume=True)
    assert resumed.evaluations == 80 and "60 renders already" in str(kept.value)


def test_another_run_s_directory_is_refused_and_the_setting_named(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "task": "voronoi", "optimizer": "cma", "loss": "mse", "budget": 20, "seed": 0, "size": 16,
        "task_seed": 0, "task_options": {"cells": 2}, "options": {"popsize": 5},
    }  # fmt: skip
    harness.run(**settings, out=tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    others: list[tuple[str, Any]] = [
        ("optimizer", "random"), ("loss", "loi"), ("seed", 1), ("size", 24),
        ("task_seed", 1), ("task_options", {"cells": 3}), ("options", {"popsize": 6}),
        ("task", "spline"),
    ]  # fmt: skip
    for key, value in others:
        other = {**settings, key: value}
        if value == "spline":
            other["task_options"] = {}
        with pytest.raises(RunDirectoryError, match=f"other settings: {key} is"):
            harness.run(**other, out=tmp_path, resume=True)
    with pytest.raises(RunDirectoryError, match="already holds a run"):
        harness.run(**settings, out=tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_damaged_directories(tmp_path: Path) -> None:
    harness.run(Tint(), "random", budget=5, out=tmp_path)
    path = tmp_path / "run.ckpt"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(CheckpointError, match="run.ckpt.*cut short"):
        harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)
    path.unlink()
    with pytest.raises(CheckpointError, match=r"holds results, but no run\.ckpt"):
        harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)
    for text in ("{", "[]", '{"format": 99, "settings": {}}', "[" * 99999, "\ud800"):
        (tmp_path / "run.json").write_bytes(text.encode("utf-8", "surrogatepass"))
        with pytest.raises(RunDirectoryError, match="not the record of a run"):
            harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)


def test_a_checkpoint_cannot_name_a_file_elsewhere(tmp_path: Path) -> None:
    from fide_plugins.runtime import checkpoint

    harness.run(Tint(), "random", budget=5, out=tmp_path)
    state = checkpoint.read(tmp_path / "run.ckpt", "run")
    for forged in ({**state, "optimizer": "../x.ckpt"}, {**state, "record": {}}, {"record": 3}):
        checkpoint.write(tmp_path / "run.ckpt", "run", forged)
        with pytest.raises(CheckpointError, match="impossible contents"):
            harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)


def test_a_renderer_that_fails_loses_nothing(tmp_path: Path) -> None:
    task = Tint()
    task.at_call[3] = lambda: 1 // 0
    with pytest.raises(RenderError, match=r"tint failed to render candidates 64 to 79.*Zero"):
        harness.run(task, "cma", budget=200, seed=0, options={"popsize": 80}, out=tmp_path)
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "failed"
    settings: dict[str, Any] = {"budget": 200, "seed": 0, "options": {"popsize": 80}}
    resumed = harness.run(Tint(), "cma", **settings, out=tmp_path, resume=True)
    assert same(resumed, harness.run(Tint(), "cma", **settings))


def test_an_optimizer_that_cannot_be_saved_hides_no_error(
    known: Callable[[type], str], tmp_path: Path
) -> None:
    class Unsaved(Random):
        def save(self, path: object) -> None:
            raise ArithmeticError("save is broken")

    task = Tint()
    task.at_call[2] = lambda: 1 // 0
    known(Unsaved)
    with pytest.raises(RenderError, match="tint failed to render") as caught:
        harness.run(task, "unsaved", budget=200, out=tmp_path, checkpoint_every=1e9)
    assert any("save is broken" in note for note in caught.value.__notes__)


def test_an_optimizer_that_fails_leaves_the_last_whole_state(
    known: Callable[[type], str], tmp_path: Path
) -> None:
    class Breaks(Random):
        def tell(self, X: object, images: object = None, losses: object = None) -> None:
            super().tell(X, images, losses)
            if self.evaluations == 15 and fail:
                raise ArithmeticError("lost")

    fail = True
    known(Breaks)
    settings: dict[str, Any] = {"optimizer": "breaks", "budget": 40, "options": {"popsize": 5}}
    with pytest.raises(ArithmeticError, match="lost"):
        harness.run(Tint(), **settings, out=tmp_path, checkpoint_every=0.0)
    assert len((tmp_path / "curve.csv").read_text().splitlines()) > 10
    assert {"best.png", "target.png", "improvements.csv"} <= {p.name for p in tmp_path.iterdir()}
    fail = False
    resumed = harness.run(Tint(), **settings, out=tmp_path, resume=True)
    assert same(resumed, harness.run(Tint(), "random", budget=40, options={"popsize": 5}))
