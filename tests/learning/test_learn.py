"""Renders on disk, training that goes on, and what `learn` refuses."""

from __future__ import annotations

import itertools
import os
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.errors import CheckpointError, OptionError, RenderError
from fide_plugins.learning import LearnProgress, Model, judging as calibration, learn, rendering
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import RenderStore, as_renderer
from fide_plugins.types import Float64

from .conftest import SIDE, SPACE, disk


def plain(x: Float64) -> Float64:
    """Gray gradient by two numbers."""
    return np.outer(np.linspace(0, x[0], SIDE), np.linspace(0, x[1], SIDE))


def settings(dim: int = 2) -> dict[str, Any]:
    return {"dim": dim, "size": [SIDE, SIDE], "seed": 0, "renderer": "plain"}


class Stop(BaseException):
    """As Ctrl-C."""


def test_an_interrupted_call_goes_on_bit_for_bit(tmp_path: Path) -> None:
    def interrupt(at: LearnProgress) -> None:
        if (at.stage, at.done) in stops:
            stops.remove((at.stage, at.done))
            raise Stop

    stops = [("render", 100), ("train", 1)]
    arguments: dict[str, Any] = {"renders": 200, "size": SIDE, "passes": 3}
    for _ in range(2):
        with pytest.raises(Stop):
            learn(plain, 2, out=tmp_path / "a", on_progress=interrupt, **arguments)
    resumed = learn(plain, 2, out=tmp_path / "a", on_progress=interrupt, **arguments)
    whole = learn(plain, 2, **arguments)
    assert not stops
    assert resumed.report.curve == whole.report.curve
    for name, value in whole.network.state_dict().items():
        torch.testing.assert_close(resumed.network.state_dict()[name], value, rtol=0, atol=0)


def test_every_stage_tells_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrating and judging take minutes where there are many parameters."""
    monkeypatch.setattr(calibration, "ENOUGH", 4)  # held-out renders: every 50th
    said: list[LearnProgress] = []
    model = learn(plain, 2, renders=400, size=SIDE, passes=2, on_progress=said.append)
    stages = [stage for stage, _ in itertools.groupby(at.stage for at in said)]
    assert stages == ["render", "train", "judge"]
    for stage in stages:
        (total,) = {at.total for at in said if at.stage == stage}
        done = [at.done for at in said if at.stage == stage]
        step = 100 if stage == "render" else 1  # a shard
        assert done == list(range(step, done[-1] + 1, step))
        assert done[-1] == total
    assert said[-1] == LearnProgress("judge", 4, 4)
    assert model.report.fitted == 4


def test_what_was_rendered_is_not_rendered_again(tmp_path: Path) -> None:
    calls = []

    def counted(params: dict[str, Any]) -> Float64:
        calls.append(params)
        return disk(params)

    arguments: dict[str, Any] = {"size": SIDE, "passes": 1, "out": tmp_path / "disk.fide"}
    learn(counted, SPACE, renders=100, **arguments)
    assert len(calls) == 1 + 100  # the first shows the shape
    learn(counted, SPACE, renders=200, **arguments)
    assert len(calls) == 2 + 200


def test_workers_render_the_same(tmp_path: Path) -> None:
    import fide_tasks

    renderer = as_renderer(fide_tasks.make("voronoi", SIDE, cells=2), None)
    stores = [RenderStore(tmp_path / name, settings(10)) for name in ("one", "two")]
    fill(stores[0], renderer, 200)
    fill(stores[1], renderer, 200, workers=2)
    for one, two in zip(stores[0].read(200), stores[1].read(200), strict=True):
        np.testing.assert_array_equal(one, two)


def test_failed_renders_are_left_out(tmp_path: Path) -> None:
    def fragile(x: Float64) -> Float64:
        if x[0] < 0.2:
            raise ValueError("no such thing")
        return plain(x)

    store = RenderStore(tmp_path, settings())
    fill(store, as_renderer(fragile, 2), 300)
    failed = sum(store.failed(300).values())
    x, images = store.read(300)
    assert len(x) == len(images) == 300 - failed
    assert x[:, 0].min() >= 0.2 and failed > 0


def test_what_was_given_up_is_rendered_when_the_renderer_is_mended(tmp_path: Path) -> None:
    mended: list[bool] = []

    def fragile(x: Float64) -> Float64:
        if x[0] != 0.5 and not mended:
            raise ValueError("no light")
        return plain(x)

    arguments: dict[str, Any] = {"size": SIDE, "passes": 1, "out": tmp_path / "m"}
    with pytest.raises(RenderError, match="500 of 500.*the first one: ValueError: no light"):
        learn(fragile, 2, renders=600, **arguments)
    with pytest.raises(RenderError, match="0 renders are too few.*100 of 100 failed; mend"):
        learn(fragile, 2, renders=100, **arguments)
    mended.append(True)
    report = learn(fragile, 2, renders=600, **arguments).report
    assert (report.renders + report.held_out, report.failed) == (600, 0)


class Forgetful:
    """A renderer whose images are all equal until it is mended."""

    mended = False

    def __call__(self, x: Float64) -> Float64:
        return plain(x if self.mended else 0 * x)


@pytest.mark.parametrize(("asked", "told"), [(100, 100), (2000, 500)])
def test_images_that_are_all_equal_are_not_learned(asked: int, told: int, tmp_path: Path) -> None:
    forgetful = Forgetful()
    arguments: dict[str, Any] = {"size": SIDE, "passes": 1, "out": tmp_path / "m"}
    with pytest.raises(RenderError, match=f"Forgetful for {told} random parameters are all equal"):
        learn(forgetful, 2, renders=asked, **arguments)
    assert not list((tmp_path / "m.renders").glob("*.npz"))
    forgetful.mended = True  # all are rendered again
    report = learn(forgetful, 2, renders=asked, **arguments).report
    assert report.renders + report.held_out == asked


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_render_that_ends_its_worker_is_one_that_failed(tmp_path: Path) -> None:
    side = SIDE

    def deadly(x: Float64) -> Float64:
        if x[0] < 0.01:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.outer(np.linspace(0, x[0], side), np.linspace(0, x[1], side))

    store = RenderStore(tmp_path, settings())
    fill(store, as_renderer(deadly, 2), 300, workers=2)
    x = np.concatenate([store.parameters(shard) for shard in range(3)])
    kept, images = store.read(300)
    np.testing.assert_array_equal(kept, x[x[:, 0] >= 0.01])
    assert sum(store.failed(300).values()) == (x[:, 0] < 0.01).sum() > 0
    again = as_renderer(plain, 2).small(kept, [0] * len(kept), (SIDE, SIDE))
    np.testing.assert_array_equal(images, again)


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_renderer_that_always_ends_its_worker_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "_MOST_LOST", 4)  # each is another process

    def always(x: Float64) -> None:
        os._exit(3)

    store = RenderStore(tmp_path, settings())
    with pytest.raises(RenderError, match="4 times in a row.*died with exit code 3"):
        fill(store, as_renderer(always, 2), 300, workers=2)
    assert store.missing(300) == [0, 1, 2]


@pytest.mark.parametrize("seed", [None, np.int64(3), 2**70 + 3])
def test_seeds_of_any_size_and_none(seed: int | None) -> None:
    model = learn(plain, 2, renders=100, size=SIDE, passes=1, seed=seed)
    x = model.sample(plain(np.array([0.3, 0.6])), 4, seed=2**70)
    assert x.shape == (4, 2)
    if seed is not None:
        same = learn(plain, 2, renders=100, size=SIDE, passes=1, seed=3)
        np.testing.assert_array_equal(same.sample(plain(np.array([0.3, 0.6])), 4, seed=2**70), x)


def test_nothing_is_written_before_it_can_begin(tmp_path: Path) -> None:
    for seed in (-1, 1.5, "a", True):
        with pytest.raises(OptionError, match="seed must be a whole number >= 0"):
            learn(plain, 2, size=SIDE, out=tmp_path / "m", seed=seed)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="workers must be a whole number >= 0"):
        learn(plain, 2, size=SIDE, out=tmp_path / "m", workers=-1)
    lock = threading.Lock()
    with pytest.raises(OptionError, match="cannot be sent to other processes .*lock"):
        learn(lambda x: plain(x) if lock else x, 2, size=SIDE, out=tmp_path / "m", workers=2)
    assert not list(tmp_path.iterdir())
    (tmp_path / "m").mkdir()
    with pytest.raises(IsADirectoryError, match="name a file for the model"):
        learn(plain, 2, size=SIDE, out=tmp_path / "m")
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_one_call_at_a_time_learns_a_file(tmp_path: Path) -> None:
    """A second one would remove what the first is writing."""
    live = tmp_path / "m.renders" / ".000000.npz.0123456789ab.tmp"
    seen: list[bool] = []

    def render(x: Float64) -> Float64:
        if live.parent.exists() and not seen:
            live.touch()
            with pytest.raises(OptionError, match="m is being learned, in another process or in"):
                learn(plain, 2, renders=100, size=SIDE, passes=1, out=tmp_path / "m", seed=1)
            seen.append(live.exists())
        return plain(x)

    learn(render, 2, renders=100, size=SIDE, passes=1, out=tmp_path / "m", seed=0)
    assert seen == [True]
    learn(render, 2, renders=100, size=SIDE, passes=1, out=tmp_path / "m", seed=0)
    assert not live.exists()  # that of a call that was killed


def test_too_little_time_is_said() -> None:
    with pytest.raises(OptionError, match="0 renders are too few.*allow more time"):
        learn(plain, 2, size=SIDE, time=1e-9)


def test_any_damaged_file_is_a_checkpoint_error(tmp_path: Path) -> None:
    options: dict[str, Any] = {"renders": 200, "size": SIDE, "passes": 1}
    model, renders = tmp_path / "m", tmp_path / "m.renders"
    learn(plain, 2, out=model, **options)
    for file, remedy in (
        (renders / "training", "delete this file, and it is trained again; the renders are kept"),
        (renders / "000001.npz", "delete it to render again"),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[:-100])
        with pytest.raises(CheckpointError, match=f"{file.name}: damaged.*; {remedy}$"):
            learn(plain, 2, out=model, **options)
        file.write_bytes(whole)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"renders": 10}, OptionError, "renders must be a whole number >= 100"),
        ({"size": 8}, OptionError, "size is 16 to 256"),
        ({"time": -1}, OptionError, "time must be a positive number of seconds"),
        ({"time": True}, OptionError, "not True"),
        ({"time": "soon"}, OptionError, "a text such as .* not 'soon'"),
        ({"augment": "photo"}, OptionError, "augment must be one of none, render, photograph, not"),
        ({"groups": [[0], [0]]}, OptionError, "without overlap"),
        ({"emulator": True}, OptionError, "an emulator needs exchangeable blocks"),
        (
            {"on_progress": 3},
            OptionError,
            "on_progress must be a function of a LearnProgress, not 3",
        ),
        ({"groups": 3}, OptionError, "groups must be at least two lists of parameter numbers"),
    ],
)
def test_arguments_are_checked_before_anything_is_rendered(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    calls: list[object] = []
    with pytest.raises(error, match=message):
        learn(calls.append, 2, **change)
    assert not calls


def test_groups_of_nobody_mean_that_nothing_is_exchangeable(tmp_path: Path) -> None:
    import fide_tasks

    arguments: dict[str, Any] = {"renders": 100, "size": SIDE, "passes": 1}
    task = fide_tasks.make("voronoi", SIDE, cells=2)  # exchangeable by its space
    groups = [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    assert learn(task, groups=[], out=tmp_path / "m", **arguments).blocks == ()
    assert Model.load(tmp_path / "m").blocks == ()
    assert learn(task, groups=groups, **arguments).blocks == tuple(map(tuple, groups))


def test_the_global_generator_is_left_alone(model: Model) -> None:
    before = torch.random.get_rng_state()
    model.sample(np.zeros((SIDE, SIDE)), 4)
    learn(plain, 2, renders=100, size=SIDE, passes=1)
    assert torch.equal(before, torch.random.get_rng_state())


def test_a_model_says_how_its_renders_were_changed(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"renders": 200, "size": SIDE, "passes": 1}
    models = {}
    for augment in ("none", "photograph"):
        file = tmp_path / augment
        learn(plain, 2, out=file, augment=augment, **arguments)
        models[augment] = Model.load(file)
        assert models[augment].report.augment == augment
        assert f"augment='{augment}'" in str(models[augment].report)
    curves = {models[augment].report.curve for augment in models}
    assert len(curves) == 2  # other images, other losses
    default = learn(plain, 2, **arguments)
    assert default.report.curve == models["photograph"].report.curve


def test_training_begins_again_where_images_are_changed_otherwise(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"renders": 200, "size": SIDE, "passes": 2}
    learn(plain, 2, out=tmp_path / "m", **arguments)
    again = learn(plain, 2, out=tmp_path / "m", augment="none", **arguments)
    fresh = learn(plain, 2, augment="none", **arguments)
    assert again.report.curve == fresh.report.curve
