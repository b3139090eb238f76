"""Renders on disk, training that goes on, and what `learn` refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.errors import CheckpointError, OptionError, RenderError, UnknownNameError
from fide_plugins.learning import LearnProgress, Model, learn
from fide_plugins.learning.renderer import as_renderer
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.store import RenderStore
from fide_plugins.space import Space
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


def test_other_renders_are_refused_with_the_difference(learned: Path) -> None:
    with pytest.raises(OptionError, match="its version is None, not '2'"):
        learn(disk, SPACE, size=SIDE, out=learned, version="2")
    with pytest.raises(OptionError, match=r"its size is \[16, 16\], not \[20, 20\]"):
        learn(disk, SPACE, size=20, out=learned)


def test_workers_render_the_same(tmp_path: Path) -> None:
    import fide_tasks

    renderer = as_renderer(fide_tasks.make("voronoi", SIDE, cells=2), None)
    stores = [RenderStore(tmp_path / name, settings(10), 1e9) for name in ("one", "two")]
    fill(stores[0], renderer, 200)
    fill(stores[1], renderer, 200, workers=2)
    for one, two in zip(stores[0].read(200), stores[1].read(200), strict=True):
        np.testing.assert_array_equal(one, two)


def test_failed_renders_are_left_out(tmp_path: Path) -> None:
    def fragile(x: Float64) -> Float64:
        if x[0] < 0.2:
            raise ValueError("no such thing")
        return plain(x)

    store = RenderStore(tmp_path, settings(), 1e9)
    failed = fill(store, as_renderer(fragile, 2), 300)
    x, images = store.read(300)
    assert len(x) == len(images) == 300 - failed
    assert x[:, 0].min() >= 0.2 and failed > 0


def test_a_renderer_that_mostly_fails_is_given_up(tmp_path: Path) -> None:
    def broken(x: Float64) -> object:
        return plain(x) if x[0] == 0.5 else np.full((SIDE, SIDE, 3), np.nan)

    with pytest.raises(RenderError, match="broken failed for 500 of 500"):
        learn(broken, 2, renders=2000, size=SIDE, out=tmp_path / "m")


def test_the_limit_of_the_store_is_kept(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="raise store_limit"):
        learn(plain, 2, renders=10_000, size=64, out=tmp_path / "m", store_limit=0.01)


def test_a_damaged_shard_is_named(tmp_path: Path) -> None:
    store = RenderStore(tmp_path, settings(), 1e9)
    fill(store, as_renderer(plain, 2), 200)
    (tmp_path / "000001.npz").write_bytes(b"PK\x03\x04 and nothing")
    with pytest.raises(CheckpointError, match="000001.npz"):
        store.read(200)


def test_time_is_kept() -> None:
    model = learn(plain, 2, renders=100, size=SIDE, passes=10_000, time=0.3)
    assert 1 <= len(model.report.curve) < 10_000


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"renders": 10}, OptionError, "renders must be a whole number >= 100"),
        ({"size": 8}, OptionError, "size is 16 to 256"),
        ({"time": -1}, OptionError, "seconds above 0"),
        ({"head": "flow"}, UnknownNameError, "unknown head 'flow'"),
        ({"head": "set"}, OptionError, "needs exchangeable blocks"),
        ({"groups": [[0], [0]]}, OptionError, "must not overlap"),
    ],
)
def test_arguments_are_checked_before_anything_is_rendered(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        learn(plain, 2, **change)


def test_a_renderer_that_fails_at_once_says_why() -> None:
    def broken(params: object) -> object:
        raise KeyError("color")

    with pytest.raises(RenderError, match="KeyError: 'color'"):
        learn(broken, SPACE)
    with pytest.raises(OptionError, match="needs its space"):
        learn(plain)


def test_the_global_generator_is_left_alone(model: Model) -> None:
    before = torch.random.get_rng_state()
    model.sample(np.zeros((SIDE, SIDE)), 4)
    learn(plain, 2, renders=100, size=SIDE, passes=1)
    assert torch.equal(before, torch.random.get_rng_state())


def test_a_space_is_kept(model: Model) -> None:
    assert isinstance(model.space, Space)
    assert model.space == SPACE
