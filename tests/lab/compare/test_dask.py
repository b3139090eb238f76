"""A real Dask scheduler and two workers, in processes of their own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fide_lab import compare
from fide_plugins.errors import OptionError

from .conftest import small

distributed = pytest.importorskip("distributed", reason="needs the extra dask")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster


@pytest.mark.thorough
def test_runs_on_a_cluster_are_those_of_one_process(cluster: Any, tmp_path: Path) -> None:
    plan = small("random", "random:popsize=30", seeds=2)
    outcomes = compare.run(plan, tmp_path / "there", dask=cluster.scheduler_address)
    assert {outcome.kind for outcome in outcomes} == {"done"} and len(outcomes) == 4
    compare.run(plan, tmp_path / "here")
    for key in plan.runs():
        there, here = (tmp_path / name / key.folder for name in ("there", "here"))
        losses = [
            [line.split(",")[1] for line in (folder / "curve.csv").read_text().splitlines()]
            for folder in (there, here)
        ]
        assert losses[0] == losses[1]
    (call,) = compare.read(tmp_path / "there").calls
    assert call["dask"] is True and call["finished"]


FAILS = """
class Fails:
    def __init__(self, dim): ...
    def ask(self, n): raise ArithmeticError("on the cluster")
    def tell(self, X, losses): ...
"""


def test_a_failure_on_a_cluster_is_recorded(cluster: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FAILS)
    plan = small(f"{tmp_path / 'mine.py'}:Fails", "random", seeds=1)
    outcomes = compare.run(plan, tmp_path / "out", dask=cluster.scheduler_address)
    notes = {outcome.kind: outcome.note for outcome in outcomes}
    assert set(notes) == {"failed", "done"} and "on the cluster" in notes["failed"]


def test_clusters_that_cannot_be_used_are_named(cluster: Any, tmp_path: Path) -> None:
    from fide_lab.compare import driver as module

    with pytest.raises(OptionError, match="no Dask scheduler answers at tcp://127.0.0.1:9"):
        timeout, module._TIMEOUT = module._TIMEOUT, 0.3
        try:
            compare.run(small(), tmp_path / "a", dask="tcp://127.0.0.1:9")
        finally:
            module._TIMEOUT = timeout
    with pytest.raises(OptionError, match="with Dask, start more workers"):
        compare.run(small(), tmp_path / "b", dask=cluster.scheduler_address, jobs=2)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
        ) as threads,
        pytest.raises(OptionError, match="must have one thread.*--nthreads 1"),
    ):
        compare.run(small(), tmp_path / "c", dask=threads.scheduler_address)
