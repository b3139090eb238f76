"""Threads: how many compute, locks; and forked processes."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from fide_lab import optimizers
from fide_plugins.fide import FIDE
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread, user_threads
from fide_plugins.types import Float32, Float64

Forked: TypeAlias = Callable[[Callable[[], object]], str]
DIM, SIZE = 60, 16
EVALUATIONS = 300


def blas_threads() -> set[int]:
    """Of NumPy's and SciPy's BLAS; OpenCV's has nothing to do."""
    found = [p for p in threadpool_info() if p["user_api"] == "blas"]
    return {p["num_threads"] for p in found if "opencv" not in p["filepath"]}


def threads() -> tuple[int, set[int]]:
    """PyTorch's, and those of BLAS."""
    return torch.get_num_threads(), blas_threads()


@pytest.fixture(params=[1, 2])
def n(request: pytest.FixtureRequest) -> Iterator[int]:
    """Threads that the user sets."""
    before = torch.get_num_threads()
    with threadpool_limits(request.param):
        torch.set_num_threads(request.param)
        yield request.param
    torch.set_num_threads(before)


@pytest.fixture
def two() -> Iterator[None]:
    before = torch.get_num_threads()
    with threadpool_limits(2):
        torch.set_num_threads(2)
        yield
    torch.set_num_threads(before)


def test_the_setting_of_the_user_comes_back(n: int) -> None:
    outside = threads()
    assert outside == (n, {n})
    for _ in range(2):
        with one_thread, one_thread:
            assert threads() == (1, {1})
            with user_threads, user_threads:
                assert threads() == outside
                with one_thread:
                    assert threads() == (1, {1})
                assert threads() == outside
            assert threads() == (1, {1})
        assert threads() == outside
    with user_threads:
        assert threads() == outside


@pytest.mark.usefixtures("two")
def test_the_last_thread_that_leaves_restores_blas() -> None:
    """They overlap in both orders; in the second, the one that limited it leaves first."""
    for leaves_last in ("this", "other"):
        entered, leave = threading.Event(), threading.Event()
        with ThreadPoolExecutor(1) as pool:

            def other(entered: Any = entered, leave: Any = leave) -> None:
                with one_thread:
                    entered.set()
                    leave.wait(60)

            with one_thread:
                done = pool.submit(other)
                assert entered.wait(60)
                if leaves_last == "this":
                    leave.set()
                    done.result(60)
                    assert blas_threads() == {1}
            if leaves_last == "other":
                assert blas_threads() == {1}
                leave.set()
                done.result(60)
        assert threads() == (2, {2})


# -- what FIDE does in how many --------------------------------------------------------------------


def render(X: Float64) -> Float32:
    weights = np.sin(np.arange(DIM * SIZE * SIZE * 3, dtype=np.float64)).reshape(DIM, -1)
    images: Float32 = (1 / (1 + np.exp((0.5 - X) @ weights))).astype(np.float32)
    return images.reshape(len(X), SIZE, SIZE, 3)


TARGET = render(np.full((1, DIM), 0.7))[0]


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("name", ["fide", "cma"])
def test_a_loss_of_the_users_computes_in_as_many_as_set(name: str) -> None:
    seen = []

    def loss(images: Float32) -> Float64:
        seen.append(threads())
        means: Float64 = images.mean(axis=(1, 2, 3), dtype=np.float64)
        return means

    opt = optimizers.make(name, DIM, TARGET, loss=loss, seed=0)
    seen.clear()
    for _ in range(2):
        X = opt.ask()
        assert threads() == (2, {2})
        opt.tell(X, render(X))
        assert threads() == (2, {2})
    assert seen == [(2, {2})] * 2


def candidates(name: str, threads: int, options: dict[str, Any]) -> Float64:
    """All that are asked in a run."""
    before = torch.get_num_threads()
    with threadpool_limits(threads):
        torch.set_num_threads(threads)
        try:
            opt, asked = optimizers.make(name, DIM, TARGET, seed=0, **options), []
            while opt.evaluations < EVALUATIONS:
                asked.append(opt.ask())
                opt.tell(asked[-1], render_alone(asked[-1]))
        finally:
            torch.set_num_threads(before)
    return np.concatenate(asked)


def render_alone(X: Float64) -> Float32:
    with one_thread:  # products in several threads may differ in the last digit
        return render(X)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("fide", {"preset": "fast"}),
        ("fide", {"preset": "balanced", "popsize": 100}),  # regressions of more than 200
        ("cma", {}),
    ],
)
def test_a_run_is_the_same_whatever_number_is_set(name: str, options: dict[str, Any]) -> None:
    one, several = (candidates(name, threads, options) for threads in (1, 2))
    np.testing.assert_array_equal(one, several)


# -- libraries that are not there yet, and forks ---------------------------------------------------

LATE = """
import sys
import numpy
from fide_plugins.runtime.threads import one_thread
with one_thread:
    pass
assert "torch" not in sys.modules, "it imports torch"
import torch, scipy.linalg
from threadpoolctl import threadpool_info
with one_thread:
    assert torch.get_num_threads() == 1, torch.get_num_threads()
    numbers = {p["filepath"]: p["num_threads"] for p in threadpool_info()}
    assert set(numbers.values()) == {1}, numbers
assert torch.get_num_threads() == 2, torch.get_num_threads()
"""


@pytest.mark.thorough
def test_a_library_that_is_imported_later_is_found() -> None:
    # MKL's, too: Dask sets it to 1 in the process of the tests
    numbers = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    ran = subprocess.run(
        [sys.executable, "-c", LATE],
        env={**os.environ, **numbers},
        timeout=120,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr


def in_parallel() -> None:
    """Begin PyTorch's threads, which a fork does not bring along."""
    large = torch.ones(1000, 1000)
    assert torch.allclose(large.exp().log(), large)


@pytest.mark.usefixtures("two")
def test_a_child_does_not_count_threads_that_it_has_not(forked: Forked) -> None:
    """Another thread is inside when the process forks; the child has BLAS as the user set it."""
    entered, leave = threading.Event(), threading.Event()

    def other() -> None:
        with one_thread:
            entered.set()
            leave.wait(60)

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(other)
        assert entered.wait(60)
        try:
            assert forked(blas_threads) == repr({2})
        finally:
            leave.set()
        done.result(60)
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_an_optimizer_does_not_wait_for_threads_of_the_parent(preset: str, forked: Forked) -> None:
    in_parallel()
    epochs: dict[str, Any] = {"epochs": 1} if preset == "paper" else {}
    opt = FIDE(DIM, TARGET, preset=preset, popsize=8, seed=0, **epochs)

    def work() -> object:
        for _ in range(2):
            X = opt.ask()
            opt.tell(X, render(X))
        return opt.evaluations

    work()
    assert forked(work) == "32"


# -- locks -----------------------------------------------------------------------------------------


class Counter:
    def __init__(self) -> None:
        self._lock = Lock()
        self.inside = self.most = self.count = 0

    @one_at_a_time
    def step(self, again: bool = True) -> int:
        """Stay a while, and call itself."""
        self.inside += 1
        self.most = max(self.most, self.inside)
        time.sleep(0.0002)
        if again:
            self.step(again=False)
        self.count += 1
        self.inside -= 1
        return self.count

    @one_at_a_time
    def fail(self) -> None:
        raise ValueError


def free(lock: Lock) -> bool:
    """Whether another thread can take it."""
    taken = []
    thread = threading.Thread(target=lambda: taken.append(lock.held.acquire(blocking=False)))
    thread.start()
    thread.join()
    return bool(taken[0])


def test_one_thread_at_a_time_and_itself_again() -> None:
    counter = Counter()
    threads = [
        threading.Thread(target=lambda: [counter.step() for _ in range(20)]) for _ in "12345678"
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter.count == 8 * 20 * 2
    assert counter.most == 2  # the one inside, and its own call


def test_copies_and_pickles_are_free() -> None:
    lock = Lock()
    with lock.held:
        assert not free(lock)
        assert free(copy.deepcopy(lock))
        assert free(pickle.loads(pickle.dumps(lock)))


def test_free_in_a_forked_process(forked: Callable[[Callable[[], object]], str]) -> None:
    """Held by another thread in the parent, which does not exist in the child."""
    lock, release = Lock(), threading.Event()

    def hold() -> None:
        with lock.held:
            release.wait()

    holder = threading.Thread(target=hold)
    holder.start()
    while free(lock):
        time.sleep(0.001)
    try:
        assert forked(lambda: lock.held.acquire(blocking=False)) == "True"
    finally:
        release.set()
        holder.join()
