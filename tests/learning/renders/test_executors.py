"""Renders in an executor of the caller."""

from __future__ import annotations

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.fitting.workers import DAEMON
from fide_plugins.learning import learn
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import RenderStore, as_renderer
from fide_plugins.types import Float64

SIDE = 16


def plain(x: Float64) -> Float64:
    """Gray gradient by two numbers."""
    return np.outer(np.linspace(0, x[0], SIDE), np.linspace(0, x[1], SIDE))


def store(folder: Path) -> RenderStore:
    return RenderStore(folder, {"dim": 2, "size": [SIDE, SIDE], "seed": 0, "renderer": "plain"})


def test_an_executor_renders_the_same_and_is_left_open(tmp_path: Path) -> None:
    lock = threading.Lock()  # which no process would take

    def locked(x: Float64) -> Float64:
        with lock:
            return plain(x)

    here, there = store(tmp_path / "here"), store(tmp_path / "there")
    fill(here, as_renderer(plain, 2), 300)
    with ThreadPoolExecutor(2) as threads:
        fill(there, as_renderer(locked, 2), 300, executor=threads, workers=2)
        assert threads.submit(int, "7").result() == 7
    for one, two in zip(here.read(300), there.read(300), strict=True):
        np.testing.assert_array_equal(one, two)


def test_an_executor_that_ends_is_said_and_what_was_rendered_is_kept(tmp_path: Path) -> None:
    made, threads = store(tmp_path), ThreadPoolExecutor(1)
    with pytest.raises(RenderError, match="takes no more renders .*shutdown.* give another one"):
        fill(
            made,
            as_renderer(plain, 2),
            10_000,
            executor=threads,
            on_progress=lambda done: threads.shutdown(),
        )
    assert 1 <= len(list(tmp_path.glob("*.npz"))) < 100


def test_what_is_no_executor_is_refused_before_anything_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="executor must be 'processes', 'threads', an executor"):
        learn(plain, 2, out=tmp_path / "m", executor="tcp://host:8786")
    assert not list(tmp_path.iterdir())


def refused_in_a_pool(out: Path) -> str:
    """Why this process, which is daemonic, does not learn with workers; it does without."""
    fill(store(out / "store"), as_renderer(plain, 2), 10, workers=1)
    try:
        learn(plain, 2, out=out / "m", workers=2)
    except OptionError as error:
        return str(error)
    return ""


@pytest.mark.thorough
def test_a_process_that_may_start_no_other_is_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[3])  # where the new process finds `tests`
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        said = pool.map(refused_in_a_pool, [tmp_path])[0]
    assert said == f"{DAEMON}; give workers=0"
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
