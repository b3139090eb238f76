"""A real Dask scheduler and two workers, in processes of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fide_plugins import fit
from fide_plugins.fitting.failures import GivenUpError, RenderFailedWarning

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


def test_a_render_that_hangs_costs_one_candidate_and_its_worker(tmp_path: Path) -> None:
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
