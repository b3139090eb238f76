"""The run loop: what it records, how it resumes, what it refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from fide_plugins import harness, losses, optimizers
from fide_plugins.baselines.cma import CMA
from fide_plugins.baselines.random import Random
from fide_plugins.errors import (
    CheckpointError,
    ImageError,
    OptionError,
    PointsError,
    RenderError,
    UnknownNameError,
)
from fide_plugins.harness import RunResult
from fide_plugins.harness.directory import RunDirectoryError
from fide_plugins.harness.loop import PIECE
from fide_plugins.points import Float64

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


@pytest.mark.parametrize("budget", [1, 5, 33, 200])
@pytest.mark.parametrize("optimizer", ["cma", "random"])
def test_the_budget_is_spent_exactly(optimizer: str, budget: int) -> None:
    task = Tint()
    options = {"popsize": 50}
    result = harness.run(task, optimizer, budget=budget, seed=2, options=options)
    assert result.evaluations == len(result.losses) == len(result.seconds) == budget
    assert len(task.seeds) == len(set(task.seeds)) == budget
    assert task.calls == sum(-(-n // PIECE) for n in [50] * (budget // 50) + [budget % 50])
    assert result.best_loss == result.losses.min()
    assert result.best_evaluation == result.losses.argmin()
    assert (np.diff(result.seconds) >= 0).all() and result.seconds[-1] <= result.wall_s


def test_it_is_the_same_as_asking_and_telling_by_hand() -> None:
    result = harness.run(Tint(), "cma", budget=70, seed=3)
    opt, losses = CMA(3, TARGET, seed=3), []
    while opt.evaluations < 70:
        X = opt.ask()[: 70 - opt.evaluations]
        opt.tell(X, np.broadcast_to(X[:, None, None, :], (len(X), 6, 8, 3)))
        losses += [float(np.square(TARGET - x.astype(np.float32), dtype=float).mean()) for x in X]
    np.testing.assert_allclose(result.losses, losses, rtol=1e-6)
    assert opt.best is not None and result.x_best is not None
    np.testing.assert_array_equal(result.x_best, opt.best.x)


def test_times_add_up() -> None:
    result = harness.run("voronoi", "cma", budget=300, size=48)
    assert set(result.times) == {"render", "encode", "train", "search"}
    assert all(t >= 0 for t in result.times.values())
    assert 0.5 * result.wall_s < sum(result.times.values()) <= result.wall_s
    assert result.render_s + result.overhead_s == pytest.approx(result.wall_s)


def test_another_loss_is_optimized_and_mse_is_reported() -> None:
    def redness(images: Any) -> Any:
        return -images[..., 0].mean(axis=(1, 2)).astype(float)

    result = harness.run(Tint(), "cma", redness, 150, seed=0)
    assert result.loss == "redness"
    assert result.best_loss < -0.9
    assert result.image is not None
    assert result.mse == pytest.approx(float(np.square(TARGET - result.image).mean()), rel=1e-5)


def test_noise_is_seeded_by_evaluation_and_the_reference_judges() -> None:
    a, b = (harness.run(NoisyTint(), "cma", budget=90, seed=1) for _ in range(2))
    assert same(a, b)
    assert a.x_best is not None
    expected = float(np.square(TARGET - a.x_best.astype(np.float32)).mean())
    assert a.mse == pytest.approx(expected, rel=1e-5)
    assert a.best_loss != a.mse


def test_the_result_of_a_noisy_task_is_judged_by_its_references(tmp_path: Path) -> None:
    task = NoisyTint()
    result = harness.run(task, "cma", "perceptual", 90, seed=1, out=tmp_path)
    assert task.calls == sum(-(-n // PIECE) for n in [7] * 12 + [6]), "judging is no render"
    assert result.x_best is not None and result.x_recommended is not None
    assert result.reference is not None and result.image is not None
    judge = losses.make("perceptual", TARGET)
    by_hand = [judge(task.reference(x)[None])[0] for x in (result.x_best, result.x_recommended)]
    assert [result.reference_loss, result.recommended_loss] == pytest.approx(by_hand, rel=1e-5)
    np.testing.assert_allclose(result.reference, task.reference(result.x_best), rtol=1e-6)
    np.testing.assert_array_equal(result.x_recommended, _recommended(tmp_path))
    totals = json.loads((tmp_path / "run.json").read_text())["totals"]
    assert totals["reference_loss"] == result.reference_loss != totals["best_loss"]
    assert totals["recommended_loss"] == result.recommended_loss
    assert totals["x_recommended"] == result.x_recommended.tolist()
    with Image.open(tmp_path / "reference.png") as png:
        expected = np.rint(result.reference * 255).astype(np.uint8)
        np.testing.assert_array_equal(np.asarray(png), expected)
    with Image.open(tmp_path / "summary.png") as png:
        assert png.width >= 800


def _recommended(out: Path) -> Any:
    (path,) = out.glob("optimizer-*.ckpt")
    return optimizers.load("cma", path).recommend()


def test_judging_takes_none_of_the_run_s_time() -> None:
    class Slow(NoisyTint):
        def reference(self, x: Float64) -> Any:
            time.sleep(0.2)
            return super().reference(x)

    result = harness.run(Slow(), "cma", budget=30)
    assert result.judge_s >= 0.4
    assert result.wall_s < result.judge_s


def test_without_a_reference_the_render_of_the_run_is_judged(tmp_path: Path) -> None:
    result = harness.run(Tint(), "cma", budget=30, out=tmp_path)
    assert result.reference_loss == result.best_loss
    assert result.x_recommended is None and np.isnan(result.recommended_loss)
    assert json.loads((tmp_path / "run.json").read_text())["totals"]["recommended_loss"] is None
    assert not (tmp_path / "reference.png").exists()


@pytest.mark.parametrize("event", [raise_interrupt, OSError("no lamp")])
def test_a_run_that_stops_while_it_is_judged_can_be_resumed(event: Any, tmp_path: Path) -> None:
    class Stopped(NoisyTint):
        def reference(self, x: Float64) -> Any:
            if isinstance(event, Exception):
                raise event
            event()
            raise AssertionError("the signal was to stop this")

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 40, "seed": 1}
    whole = harness.run(NoisyTint(), **settings)
    with pytest.raises((harness.Interrupted, RenderError)) as caught:
        harness.run(Stopped(), **settings, out=tmp_path)
    if isinstance(event, Exception):
        assert caught.match("noisytint|tint failed to judge the result: .*no lamp")
    wall = json.loads((tmp_path / "run.json").read_text())["totals"]["wall_s"]
    task = NoisyTint()
    resumed = harness.run(task, **settings, out=tmp_path, resume=True)
    assert task.calls == 0
    assert same(whole, resumed)
    assert resumed.wall_s == pytest.approx(wall, abs=0.5)


def test_a_renderer_that_fails_at_the_target_is_named() -> None:
    class Dark:
        name, dim, render = "dark", 3, Tint.render

        @property
        def target(self) -> Any:
            raise RuntimeError("no lamp")

    with pytest.raises(RenderError, match="dark failed to render its target: no lamp"):
        harness.prepare(cast(Any, Dark()), "cma")


@pytest.mark.parametrize(
    ("point", "said"),
    [([0.5, 0.5, np.nan], "must lie in"), ([0.5] * 4, "the shape"), (2.0 * np.ones(3), "= 2.0")],
)
def test_an_optimizer_that_recommends_no_point_is_named(point: Any, said: str) -> None:
    class Lost(Random):
        name = "lost"

        def recommend(self) -> Any:
            return np.asarray(point)

    class Raises(Random):
        def recommend(self) -> Any:
            raise ZeroDivisionError("nothing was told")

    with pytest.raises(PointsError, match=f"lost recommended an impossible point: .*{said}"):
        harness.run(Tint(), Lost, budget=5)
    with pytest.raises(ZeroDivisionError, match="nothing was told"):  # not the renderer's fault
        harness.run(Tint(), Raises, budget=5)


def test_options_that_leave_every_image_as_it_is_may_change_on_resuming(tmp_path: Path) -> None:
    class Parallel(Tint):
        incidental_options = ("workers",)

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 5, "out": tmp_path}
    harness.run(Parallel(), **settings, task_options={"workers": 1, "mood": "calm"})
    harness.run(Parallel(), **settings, task_options={"workers": 2, "mood": "calm"}, resume=True)
    with pytest.raises(RunDirectoryError, match="other settings: task_options"):
        harness.run(Parallel(), **settings, task_options={"mood": "wild"}, resume=True)


def test_a_run_is_resumed_only_where_the_same_renderer_is(tmp_path: Path) -> None:
    class Here(Tint):
        renderer = "llvm"

    class Elsewhere(Tint):
        renderer = "scalar"

    settings: dict[str, Any] = {"optimizer": "cma", "budget": 5, "out": tmp_path}
    harness.run(Here(), **settings)
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["renderer"] == "llvm"
    harness.run(Here(), **settings, resume=True)
    with pytest.raises(RunDirectoryError, match="renderer is 'llvm' there and 'scalar' here"):
        harness.run(Elsewhere(), **settings, resume=True)


def test_losses_that_are_not_finite_are_recorded_and_never_best(tmp_path: Path) -> None:
    def broken(images: Any) -> Any:
        values = images.mean(axis=(1, 2, 3)).astype(float)
        return np.where(values < 0.5, np.nan, values)

    result = harness.run(Tint(), "cma", broken, 60, seed=0, out=tmp_path / "a")
    assert np.isnan(result.losses).any() and result.best_loss >= 0.5

    result = harness.run(
        Tint(), "cma", lambda images: [np.inf] * len(images), 20, out=tmp_path / "b"
    )
    assert result.x_best is None and result.summary()["best_loss"] is None
    totals = json.loads((tmp_path / "b" / "run.json").read_text())["totals"]
    assert totals["mse"] is None and totals["x_best"] is None


def test_the_run_directory(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "a"
    result = harness.run("spline", "cma", "mse", 80, 4, size=40, out=out, command=["fide", "a b"])
    assert {p.name for p in out.iterdir()} == {
        "run.json", "curve.csv", "improvements.csv", "best.png", "summary.png", "run.ckpt",
        "optimizer-80-0.ckpt",
    }  # fmt: skip
    run = json.loads((out / "run.json").read_text())
    assert run["status"] == "finished" and run["command"] == "fide 'a b'"
    assert run["settings"]["task"] == "spline" and run["settings"]["seed"] == 4
    assert {"python", "numpy", "fide-plugins"} <= set(run["versions"])
    assert run["machine"]["cores"] >= 1
    assert run["totals"].items() >= result.summary().items()
    with open(out / "curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["loss"]) for row in rows] == result.losses.tolist()
    best = np.minimum.accumulate(result.losses)
    assert [float(row["best_loss"]) for row in rows] == best.tolist()
    assert [int(row["evaluation"]) for row in rows] == list(range(80))
    with Image.open(out / "best.png") as png:
        assert result.image is not None
        np.testing.assert_array_equal(np.asarray(png), np.rint(result.image * 255).astype(np.uint8))
    with Image.open(out / "summary.png") as png:
        pixels = np.asarray(png.convert("RGB"))
        assert png.width >= 800 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize("optimizer", ["cma", "random"])
@pytest.mark.parametrize("call", [1, 2, 4, 5])
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
    assert run["status"] == "interrupted"
    assert run["totals"]["evaluations"] == [0, 32, 64, 70, 102][call - 1]
    resumed = harness.run(NoisyTint(), optimizer, **settings, out=tmp_path, resume=True)
    assert same(whole, resumed)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["status"] == "finished" and len(run["resumed"]) == 1
    assert len(list(tmp_path.glob("optimizer-*.ckpt"))) == 1
    task = NoisyTint()
    assert same(whole, harness.run(task, optimizer, **settings, out=tmp_path, resume=True))
    assert task.calls == 0  # it was finished


def test_a_kill_between_the_two_files_of_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fide_plugins import checkpoint

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


def test_a_signal_inside_the_optimizer_waits_for_the_step_to_end(tmp_path: Path) -> None:
    class Slow(Random):
        def tell(self, X: object, images: object = None, losses: object = None) -> None:
            if self.evaluations == 5:
                raise_interrupt()
                time.sleep(0.01)
            super().tell(X, images, losses)

    optimizers.register("slow", Slow)
    try:
        settings: dict[str, Any] = {"optimizer": "slow", "budget": 40, "options": {"popsize": 5}}
        with pytest.raises(harness.Interrupted):
            harness.run(Tint(), **settings, out=tmp_path)
        assert len((tmp_path / "curve.csv").read_text().splitlines()) == 1 + 10
        resumed = harness.run(Tint(), **settings, out=tmp_path, resume=True)
        assert same(resumed, harness.run(Tint(), "random", budget=40, options={"popsize": 5}))
    finally:
        optimizers._CLASSES.pop("slow")


def test_handlers_of_signals_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    harness.run(Tint(), "random", budget=3)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


KILLED = """
import sys, time
from fide_plugins import harness
import fide_tasks

task = fide_tasks.make("voronoi", size=32, cells=2)
draw = task.render
left = int(sys.argv[2])
def render(X, seed=None):
    global left
    left -= len(X)
    time.sleep(0.004 * len(X) if left > 0 else 3600)
    return draw(X, seed)
task.render = render
harness.run(task, "cma", budget=700, seed=9, out=sys.argv[1], resume=True, checkpoint_every=0)
"""


def test_resuming_after_sigkill_gives_the_uninterrupted_result(tmp_path: Path) -> None:
    import fide_tasks

    whole = harness.run(fide_tasks.make("voronoi", size=32, cells=2), "cma", budget=700, seed=9)
    out = tmp_path / "run"
    evaluations: list[int] = []
    for _ in range(2):
        child = subprocess.Popen([sys.executable, "-c", KILLED, str(out), "300"])
        seen = evaluations[-1] if evaluations else 0
        while (count := _saved(out)) < seen + 40:
            assert child.poll() is None, "the run ended before it was killed"
            time.sleep(0.005)
        child.kill()
        child.wait()
        evaluations.append(max(count, _saved(out)))
        assert json.loads((out / "run.json").read_text())["status"] == "running"
    (out / ".run.json.00.tmp").touch()  # what a killed writer leaves
    task = fide_tasks.make("voronoi", size=32, cells=2)
    assert same(whole, harness.run(task, "cma", budget=700, seed=9, out=out, resume=True))
    assert not list(out.glob(".*"))


def _saved(out: Path) -> int:
    return max([int(p.stem.split("-")[1]) for p in out.glob("optimizer-*.ckpt")], default=0)


def test_another_run_s_directory_is_refused_and_the_setting_named(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "task": "voronoi", "optimizer": "cma", "loss": "mse", "budget": 20, "seed": 0, "size": 16,
        "task_seed": 0, "task_options": {"cells": 2}, "options": {"popsize": 5},
    }  # fmt: skip
    harness.run(**settings, out=tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    others: list[tuple[str, Any]] = [
        ("optimizer", "random"), ("loss", "loi"), ("budget", 30), ("seed", 1), ("size", 24),
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


def test_a_target_that_changed_is_another_run(tmp_path: Path) -> None:
    harness.run(Tint(), "random", budget=5, out=tmp_path)
    other = Tint()
    other.target = TARGET[::-1]
    with pytest.raises(RunDirectoryError, match="other settings: target is"):
        harness.run(other, "random", budget=5, out=tmp_path, resume=True)


def test_damaged_directories(tmp_path: Path) -> None:
    harness.run(Tint(), "random", budget=5, out=tmp_path)
    path = tmp_path / "run.ckpt"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(CheckpointError, match="run.ckpt.*cut short"):
        harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)
    for text in ("{", "[]", '{"format": 99, "settings": {}}', "[" * 99999, "\ud800"):
        (tmp_path / "run.json").write_bytes(text.encode("utf-8", "surrogatepass"))
        with pytest.raises(RunDirectoryError, match="not the record of a run"):
            harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)


def test_a_checkpoint_cannot_name_a_file_elsewhere(tmp_path: Path) -> None:
    from fide_plugins import checkpoint

    harness.run(Tint(), "random", budget=5, out=tmp_path)
    state = checkpoint.read(tmp_path / "run.ckpt", "run")
    for forged in ({**state, "optimizer": "../x.ckpt"}, {**state, "record": {}}, {"record": 3}):
        checkpoint.write(tmp_path / "run.ckpt", "run", forged)
        with pytest.raises(CheckpointError, match="impossible contents"):
            harness.run(Tint(), "random", budget=5, out=tmp_path, resume=True)


def test_a_directory_that_cannot_be_written_is_refused_before_rendering(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    task = Tint()
    with pytest.raises(OSError, match="cannot write to the folder"):
        harness.run(task, "random", budget=5, out=tmp_path / "file" / "run")
    assert task.calls == 0


def test_a_renderer_that_fails_loses_nothing(tmp_path: Path) -> None:
    task = Tint()
    task.at_call[3] = lambda: 1 // 0
    with pytest.raises(RenderError, match=r"tint failed to render candidates 64 to 79.*Zero"):
        harness.run(task, "cma", budget=200, seed=0, options={"popsize": 80}, out=tmp_path)
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "failed"
    settings: dict[str, Any] = {"budget": 200, "seed": 0, "options": {"popsize": 80}}
    resumed = harness.run(Tint(), "cma", **settings, out=tmp_path, resume=True)
    assert same(resumed, harness.run(Tint(), "cma", **settings))


def test_an_optimizer_that_fails_leaves_the_last_whole_state(tmp_path: Path) -> None:
    class Breaks(Random):
        def tell(self, X: object, images: object = None, losses: object = None) -> None:
            super().tell(X, images, losses)
            if self.evaluations == 15 and fail:
                raise ArithmeticError("lost")

    fail = True
    optimizers.register("breaks", Breaks)
    try:
        settings: dict[str, Any] = {"optimizer": "breaks", "budget": 40, "options": {"popsize": 5}}
        with pytest.raises(ArithmeticError, match="lost"):
            harness.run(Tint(), **settings, out=tmp_path, checkpoint_every=0.0)
        fail = False
        resumed = harness.run(Tint(), **settings, out=tmp_path, resume=True)
        assert same(resumed, harness.run(Tint(), "random", budget=40, options={"popsize": 5}))
    finally:
        optimizers._CLASSES.pop("breaks")


def test_bad_renders_and_settings_are_named(tmp_path: Path) -> None:
    class Wrong(Tint):
        def render(self, X: Float64, seed: Any = None) -> Any:
            return np.zeros((len(X), 5, 8, 3), np.float32)

    with pytest.raises(ImageError):
        harness.run(Wrong(), "random", budget=5)
    with pytest.raises(OptionError, match="budget"):
        harness.run(Tint(), "random", budget=0)
    with pytest.raises(OptionError, match="seed"):
        harness.run(Tint(), "random", seed=-1)
    with pytest.raises(UnknownNameError, match="optimizer"):
        harness.run(Tint(), "none")
    with pytest.raises(UnknownNameError, match="loss"):
        harness.run(Tint(), "random", "none")
    with pytest.raises(ValueError, match="voronoi"):
        harness.run("none", "random")
    with pytest.raises(OptionError, match="its options: loss, popsize"):
        harness.run(Tint(), "random", options={"epochs": 3}, out=tmp_path / "never")
    with pytest.raises(OptionError, match="seed is an argument of the run"):
        harness.run(Tint(), "random", options={"seed": 3})
    with pytest.raises(OptionError, match="by name"):
        harness.run(Tint(), Random, budget=5, out=tmp_path / "never")
    assert not (tmp_path / "never").exists()
    assert harness.run(Tint(), Random, budget=5).optimizer == "random"


def test_overshooting_renders_warn_once() -> None:
    class Bright(Tint):
        def render(self, X: Float64, seed: Any = None) -> Any:
            return super().render(X, seed) * 2.0

    with pytest.warns(RuntimeWarning) as caught:
        harness.run(Bright(), "random", budget=200)
    assert len(caught) == 1
