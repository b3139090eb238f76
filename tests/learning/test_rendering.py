"""Renders in executors, and on a cluster."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_plugins.cli import main
from fide_plugins.errors import OptionError, RenderError
from fide_plugins.learning import LearnProgress, Model, learn, rendering
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import RenderStore, as_renderer
from fide_plugins.runtime import checkpoint
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


distributed = pytest.importorskip("distributed", reason="needs the extra dask")

SCENE = """
import numpy as np
from fide_plugins import Float, Space

space = Space(left=Float(0, 1), right=Float(0, 1))


def render(params):
    return np.repeat(np.linspace(params["left"], params["right"], 16)[None], 16, axis=0)
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    import dask

    settings = {
        "distributed.scheduler.allowed-failures": 0,
        "distributed.deploy.lost-worker-timeout": "200 s",  # to start another one, if it is busy
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster,
    ):
        yield cluster


@pytest.fixture
def client(cluster: Any) -> Iterator[Any]:
    with distributed.Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        yield client


def stored(model: Path, renders: int) -> Any:
    """Parameters and images beside a model."""
    folder = Path(f"{model}.renders")
    there = checkpoint.read(folder / "settings", "renders")
    del there["fingerprint"]
    return RenderStore(folder, there).read(renders)


def store_in(folder: Path, dim: int = 2) -> RenderStore:
    return RenderStore(folder, {"dim": dim, "size": [SIDE, SIDE], "seed": 0, "renderer": "r"})


@pytest.mark.thorough
def test_a_cluster_renders_the_same_and_goes_on(client: Any, tmp_path: Path) -> None:
    task = fide_tasks.make("voronoi", SIDE, cells=2)

    def stop(at: LearnProgress) -> None:
        if (at.stage, at.done) == ("render", 200):
            raise KeyboardInterrupt

    arguments: dict[str, Any] = {"renders": 400, "size": SIDE, "passes": 1}
    there = tmp_path / "there"
    with pytest.raises(KeyboardInterrupt):
        learn(task, out=there, executor=client, workers=2, on_progress=stop, **arguments)
    kept = {path: path.stat().st_mtime_ns for path in Path(f"{there}.renders").glob("*.npz")}
    assert len(kept) == 2
    learn(task, out=there, executor=client, **arguments)
    learn(task, out=tmp_path / "here", **arguments)
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    for one, two in zip(*(stored(tmp_path / name, 400) for name in ("there", "here")), strict=True):
        np.testing.assert_array_equal(one, two)
    assert client.submit(int, "7").result() == 7  # it is the caller's


def test_a_lost_scheduler_is_said_and_what_was_rendered_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "_LOOK", 0.1)
    task = fide_tasks.make("voronoi", SIDE, cells=2)
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    )
    with cluster, distributed.Client(cluster, timeout=1, set_as_default=False) as client:
        made = store_in(tmp_path, 10)
        with pytest.raises(RenderError, match="cluster is lost: start it|start the cluster again"):
            fill(
                made,
                as_renderer(task, None),
                10_000,
                executor=client,
                workers=1,
                on_progress=lambda done: cluster.close(),
            )
    assert 1 <= len(list(tmp_path.glob("*.npz"))) < 100


def test_the_command_learns_on_a_cluster(
    cluster: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("gradient.py").write_text(SCENE)
    words = ["learn", "gradient.py:render", "--size", "16", "--passes", "1", "--out", "m.fide"]
    assert main([*words, "--renders", "200", "--dask", cluster.scheduler_address]) == 0
    assert Model.load("m.fide").report.renders == 196
    assert main([*words, "--renders", "300", "--resume", "--workers", "1"]) == 0
    x, images = stored(Path("m.fide"), 300)
    expected = np.rint(255 * (x[:, :1] + (x[:, 1:] - x[:, :1]) * np.linspace(0, 1, 16)))
    assert np.abs(images[:, 0, :, 0] - expected).max() <= 1
    capsys.readouterr()
    assert main([*words, "--workers", "2", "--dask", cluster.scheduler_address]) == 2
    assert "not allowed with" in capsys.readouterr().err
