"""Acceptance point 23: `minimize`, its executors, results of every kind, late ones, penalties."""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nevergrad as ng
import numpy as np
import pytest

from fide_adapters.nevergrad import DaskExecutor, ImageLoss
from fide_plugins.fide import FIDE

from .conftest import TARGET, box, fide, mse, objective, render, told, traveling


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
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield DaskExecutor(client)


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
    assert optimizer.num_tell == optimizer.num_ask == optimizer._engine._pictures == budget
    assert optimizer.num_tell_not_asked == 0 and optimizer.num_objectives == 1


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing_but_time(tmp_path: Path) -> None:
    """SIGKILL in the midst: every candidate counts exactly once."""
    optimizer = fide(budget=40, workers=2)
    victim = tmp_path / "killed"
    inner = traveling().function

    def sometimes_deadly(x: Any) -> Any:
        time.sleep(0.02)
        try:
            victim.touch(exist_ok=False)
        except FileExistsError:
            return inner(x)
        os.kill(os.getpid(), 9)

    counted: list[Any] = []
    optimizer.register_callback("tell", lambda _, c, loss: counted.append(c.uid))
    with dask(tmp_path) as executor:
        optimizer.minimize(sometimes_deadly, executor=executor)
    assert victim.exists()
    assert len(set(counted)) == len(counted) == 40 == optimizer._engine._pictures


def test_dask_keeps_no_argument_and_no_old_result() -> None:
    """Parameters may be called `key`, and a noisy objective is called each time."""
    distributed = pytest.importorskip("distributed", reason="needs the extra dask")

    def noisy(key: float, workers: float) -> Any:
        return key, workers, time.perf_counter_ns()

    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=":0"
    ) as client:
        executor = DaskExecutor(client)
        futures = [executor.submit(noisy, key=0.5, workers=2.0) for _ in range(3)]
        results = {future.result() for future in futures}
    assert len(results) == 3 and {result[:2] for result in results} == {(0.5, 2.0)}


RESULTS: dict[str, Any] = {
    "ImageLoss": objective,
    "image": render,
    "pair": lambda x: (mse(render(x)), render(x)),
    "loss and None": lambda x: (mse(render(x)), None),
    "float": lambda x: mse(render(x)),
    "numpy": lambda x: np.float32(mse(render(x))),
    "a list of one": lambda x: [mse(render(x))],
}


@pytest.mark.filterwarnings("ignore::fide_adapters.nevergrad.NoImagesWarning")
@pytest.mark.parametrize("kind", RESULTS)
def test_point_23_results(kind: str) -> None:
    optimizer = fide(budget=30)
    best = optimizer.minimize(RESULTS[kind])
    assert optimizer.num_objectives == 1
    assert optimizer._engine._pictures == (30 if kind in ("ImageLoss", "image", "pair") else 0)
    assert best.loss == pytest.approx(mse(render(best.value)), rel=1e-6)


def test_point_23_results_may_be_mixed() -> None:
    kinds = [RESULTS[kind] for kind in ("float", "ImageLoss", "loss and None", "image", "pair")]
    calls = []

    def mixed(x: Any) -> Any:
        calls.append(x)
        return kinds[len(calls) % 5](x)

    optimizer = fide(budget=50)
    best = optimizer.minimize(mixed)
    assert optimizer._engine._pictures == 30 and optimizer.num_objectives == 1
    assert best.loss == pytest.approx(mse(render(best.value)), rel=1e-6)


def test_another_optimizer_takes_an_image_loss_for_its_loss() -> None:
    optimizer = ng.optimizers.OnePlusOne(box(), budget=20)
    best = optimizer.minimize(objective)
    assert type(best.loss) is float and best.loss == mse(render(best.value))


def test_point_23_late_and_unknown_points_are_told_by_the_rules_of_fide() -> None:
    """Out of order, over generations, some never asked: as FIDE alone is told the same."""
    optimizer, alone = fide(popsize=8), FIDE(6, TARGET, popsize=8, seed=0)
    rng = np.random.default_rng(3)
    out: list[tuple[Any, Any]] = []
    late = 0
    for step in range(120):
        while len(out) < 12:
            candidate, X = optimizer.ask(), alone.ask(1)
            np.testing.assert_allclose(candidate.value, X[0], atol=1e-9)
            out.append((candidate, X))
        candidate, X = out.pop(int(rng.integers(len(out))))
        if step % 20 == 7:  # a guess of the user's
            x = rng.random(6)
            guess = optimizer.parametrization.spawn_child(new_value=x)
            optimizer.tell(guess, render(x))
            alone.tell(x[None], [render(x)])
        optimizer.tell(candidate, render(candidate.value))
        alone.tell(X, [render(X[0])])
        late += any(c.late for c, _ in alone._ledger._told)
    assert late > 0 and optimizer.num_tell_not_asked == 6
    assert optimizer._engine.fide.evaluations == alone.evaluations == 126


def test_point_23_a_candidate_that_is_told_twice_is_a_guest_the_second_time() -> None:
    optimizer = fide()
    candidate = optimizer.ask()
    optimizer.tell(candidate, render(candidate.value))
    optimizer.tell(candidate, render(candidate.value))
    made = optimizer._engine.fide
    assert (made.evaluations, len(made._ledger._told), made._guest is not None) == (2, 1, True)


def test_point_23_the_value_of_a_candidate_stands_for_it() -> None:
    """A copy of it, from a database say, counts as the one that was asked."""
    optimizer = fide()
    asked = [optimizer.ask() for _ in range(3)]
    for candidate in asked:
        copy = optimizer.parametrization.spawn_child(new_value=candidate.value)
        optimizer.tell(copy, render(copy.value))
    made = optimizer._engine.fide
    assert len(made._ledger._told) == 3 and made._ledger.asked == 0


def test_point_23_a_suggestion_is_asked_and_told() -> None:
    optimizer = fide(popsize=8)
    optimizer.suggest(np.full(6, 0.4))
    first = optimizer.ask()
    np.testing.assert_array_equal(first.value, np.full(6, 0.4))
    optimizer.tell(first, render(first.value))
    assert optimizer._engine.fide._guest is not None
    told(optimizer, 8)
    assert optimizer._engine.fide._search.generation == 1


def test_point_23_penalties_rank_and_leave_the_loss_alone() -> None:
    optimizer, twin = fide(popsize=8), fide(popsize=8)
    for i in range(8):
        candidate, other = optimizer.ask(), twin.ask()
        image = render(candidate.value)
        broken = i < 4
        optimizer.tell(candidate, image, [10.0 if broken else 0.0])
        assert candidate.loss == pytest.approx(mse(image), rel=1e-12)
        penalized = candidate.loss
        if i < 7:  # then the generation is complete
            _, penalized = optimizer._engine.fide._ledger._told[i]
            assert (penalized > candidate.loss) == broken
            assert optimizer._engine.fide._lessons[i].loss == penalized
        twin.tell(other, penalized, image=image)
    for _ in range(8):
        np.testing.assert_allclose(optimizer.ask().value, twin.ask().value, atol=1e-9)


def test_point_23_what_is_recommended_breaks_no_constraint() -> None:
    """The disk must be on the left, where the target's is not."""
    optimizer = fide(budget=130)
    best = optimizer.minimize(objective, constraint_violation=[lambda x: max(0.0, x[0] - 0.4)])
    assert best.value[0] <= 0.4
    assert best.value[0] > 0.3


@pytest.mark.filterwarnings("ignore::nevergrad.common.errors.NevergradWarning")
@pytest.mark.parametrize("loss", [math.nan, math.inf, -math.inf, 1e300])
def test_point_23_failures_rank_last_and_teach_nothing(loss: float) -> None:
    optimizer = fide(popsize=8)
    for i in range(8):
        candidate = optimizer.ask()
        image = render(candidate.value)
        optimizer.tell(candidate, ImageLoss(loss if i % 2 else mse(image), image))
    made = optimizer._engine.fide
    assert made.not_finite == 4 and made.best.loss < 1.0
    assert len(made._proposer.state_dict()["losses"]) == 4
    for _ in range(50):
        assert np.isfinite(optimizer.ask().value).all()


def test_point_23_an_objective_that_fails_can_be_mended() -> None:
    """Nevergrad raises it; after that the search goes on and counts everything once."""
    optimizer, broken = fide(budget=20), [True]

    def sometimes(x: Any) -> Any:
        if broken[0] and optimizer.num_tell == 10:
            raise RuntimeError("the renderer failed")
        return objective(x)

    with pytest.raises(RuntimeError, match="the renderer failed"):
        optimizer.minimize(sometimes)
    broken[0] = False
    optimizer.minimize(sometimes)
    assert optimizer.num_tell == optimizer._engine._pictures == 20
