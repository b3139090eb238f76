"""A real Dask scheduler and two workers, in processes of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from fide_plugins import fit
from fide_plugins.fitting import workers as workers_module
from fide_plugins.fitting.failures import GivenUpError, RenderFailedWarning
from fide_plugins.fitting.workers import OfExecutor

from .scene import SPACE, disk, target

distributed = pytest.importorskip("distributed", reason="needs the extra dask")


def test_a_client_of_dask_renders() -> None:
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client:
        for executor in (client, client.get_executor(pure=False)):
            result = fit(disk(), target(), SPACE, budget=20, executor=executor, workers=2, seed=0)
            assert result.evaluations == 20 and result.failures == 0
            assert result.best is not None and result.best.loss == result.curve[-1, 1]
        assert client.submit(int, "7").result() == 7


class Silent:
    """Executor that tells nothing of what runs; its future ends when the test says so."""

    def __init__(self) -> None:
        self.future: Future[Any] = Future()

    def submit(self, *_: Any) -> Future[Any]:
        return self.future


def test_a_worker_that_has_died_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    silent: Any = Silent()
    workers = OfExecutor(silent, abs, 1, own=False)
    assert not workers.abandon(workers.submit(1)), "nobody told that it began"
    assert workers.usable == 0 and not silent.future.cancelled()
    monkeypatch.setattr(workers_module, "_RETURNS", 0.01)
    assert not workers.comes_back(None)
    monkeypatch.setattr(workers_module, "_RETURNS", 60.0)
    threading.Timer(0.1, silent.future.set_exception, [OSError("its worker died")]).start()
    assert workers.comes_back(None) and workers.usable == 1


def hanging(gate: Path, times: int) -> Callable[[Any], Any]:
    """Function of which so many calls do not return before the file `gate` is there."""
    draw, name = disk(), str(gate)

    def render(params: dict[str, float]) -> Any:
        import time
        from pathlib import Path

        for number in range(times):
            try:
                Path(f"{name}-{number}").touch(exist_ok=False)
            except FileExistsError:
                continue
            while not Path(name).exists():
                time.sleep(0.05)
        return draw(params)

    return render


@pytest.mark.thorough
def test_a_render_that_hangs_costs_one_candidate_and_its_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "_RETURNS", 1.0)
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client:
        arguments: dict[str, Any] = {"executor": client, "workers": 2, "seed": 0}
        fit(disk(), target(), SPACE, budget=4, **arguments)  # workers load what they need
        arguments["timeout"] = 4
        with pytest.warns(RenderFailedWarning, match="no result within timeout=4 seconds"):
            one = fit(hanging(tmp_path / "one", 1), target(), SPACE, budget=12, **arguments)
        (tmp_path / "one").touch()
        assert (one.evaluations, one.failures) == (12, 1)
        with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError, match="2 workers hang"):
            fit(hanging(tmp_path / "all", 9), target(), SPACE, budget=12, **arguments)
        (tmp_path / "all").touch()
