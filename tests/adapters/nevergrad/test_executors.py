"""Acceptance point 23: executors of `minimize`."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from .conftest import fide, mse, render, traveling


@contextmanager
def threads(folder: Path) -> Iterator[Any]:
    with concurrent.futures.ThreadPoolExecutor(3) as executor:
        yield executor


@contextmanager
def processes(folder: Path) -> Iterator[Any]:
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as executor:
        yield executor


@contextmanager
def dask(folder: Path) -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs the extra dask")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=True, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client.get_executor(pure=False)


@contextmanager
def submitit(folder: Path) -> Iterator[Any]:
    module = pytest.importorskip("submitit", reason="not installed")
    executor = module.LocalExecutor(folder=folder / "jobs")
    executor.update_parameters(timeout_min=5)
    yield executor


EXECUTORS = {
    "threads": (threads, 24),
    "processes": (processes, 24),
    "dask": (dask, 24),
    "submitit": (submitit, 4),
}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:Ignoring since timer was stopped")  # of Nevergrad's batches
@pytest.mark.parametrize(
    "name", ["threads", "processes", "dask", pytest.param("submitit", marks=pytest.mark.slow)]
)
def test_point_23_executors(name: str, tmp_path: Path) -> None:
    """Every result comes back once, with its image, in both modes; from real processes."""
    executor_of, budget = EXECUTORS[name]
    optimizer = fide(budget=budget, workers=3)
    seen: list[float] = []
    optimizer.register_callback("tell", lambda _, c, loss: seen.append(loss - mse(render(c.value))))
    with executor_of(tmp_path) as executor:
        optimizer.budget = budget // 2
        optimizer.minimize(traveling(), executor=executor, batch_mode=True)
        optimizer.budget = budget
        optimizer.minimize(traveling(), executor=executor, batch_mode=False)
    np.testing.assert_allclose(seen, np.zeros(budget), atol=1e-9)  # each with its own candidate
    assert optimizer.num_tell == optimizer.num_ask == optimizer.num_images == budget
    assert optimizer.num_tell_not_asked == 0 and optimizer.num_objectives == 1


@pytest.mark.filterwarnings("ignore:num_workers = 3 > 1 is suboptimal")  # of no executor
@pytest.mark.parametrize("name", ["threads", None])
def test_after_an_objective_has_raised_minimize_goes_on(name: str | None, tmp_path: Path) -> None:
    """Where a candidate always fails, too, which Nevergrad would tell again and again."""

    def fails(x: Any) -> Any:
        if x[0] < 0.4:
            raised.add(tuple(x))
            raise ArithmeticError("too far to the left")
        return render(x)

    optimizer, calls, failed = fide(budget=40, workers=3), 0, 0
    raised: set[tuple[float, ...]] = set()
    with threads(tmp_path) if name else nullcontext() as executor:
        while optimizer.num_ask < 40 or calls == failed:
            calls += 1
            assert calls <= 40
            try:
                optimizer.minimize(fails, executor=executor)
            except ArithmeticError:
                failed += 1
    assert failed > 1 and optimizer.num_ask == 40
    assert optimizer.num_tell == optimizer.num_images == 40 - len(raised)
    assert len(optimizer.fide.state.population.pending) == 0
