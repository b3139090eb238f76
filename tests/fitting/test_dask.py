"""A real Dask scheduler and two workers, in processes of their own."""

from __future__ import annotations

import pytest

from fide_plugins import fit

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
