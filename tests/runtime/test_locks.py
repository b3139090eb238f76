"""Locks: one thread at a time, and free again in copies and in forked processes."""

from __future__ import annotations

import copy
import pickle
import threading
import time
from collections.abc import Callable

import pytest

from fide_plugins.runtime.threads import Lock, one_at_a_time


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
    thread = threading.Thread(target=lambda: taken.append(lock._lock.acquire(blocking=False)))
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


def test_free_after_an_error() -> None:
    counter = Counter()
    with pytest.raises(ValueError):
        counter.fail()
    assert free(counter._lock)


def test_copies_and_pickles_are_free() -> None:
    lock = Lock()
    with lock:
        assert not free(lock)
        assert free(copy.deepcopy(lock))
        assert free(pickle.loads(pickle.dumps(lock)))


def test_free_in_a_forked_process(forked: Callable[[Callable[[], object]], str]) -> None:
    """Held by another thread in the parent, which does not exist in the child."""
    lock, release = Lock(), threading.Event()

    def hold() -> None:
        with lock:
            release.wait()

    holder = threading.Thread(target=hold)
    holder.start()
    while free(lock):
        time.sleep(0.001)
    try:
        assert forked(lambda: lock._lock.acquire(blocking=False)) == "True"
    finally:
        release.set()
        holder.join()
