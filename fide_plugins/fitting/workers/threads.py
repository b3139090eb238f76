"""Threads that do not keep the process alive when a render never returns.

Python waits at its end for all threads of a `ThreadPoolExecutor`: one render that hangs would hold
the script for ever, long after the fit has given its result.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, TypeAlias, TypeVar
from weakref import WeakSet

__all__ = ["DaemonThreads"]

P = ParamSpec("P")
T = TypeVar("T")

_GRACE = 1.0  # seconds at the end of the process for renders that are about to return

_Job: TypeAlias = tuple["Future[Any]", Callable[[], Any]]
_ALL: WeakSet[threading.Thread] = WeakSet()


class DaemonThreads(Executor):
    """Executor of as many threads, each started with a job until all are there."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._threads: list[threading.Thread] = []
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call the function as soon as a thread is free."""
        future: Future[T] = Future()
        self._jobs.put((future, partial(fn, *args, **kwargs)))
        if len(self._threads) < self._number:
            name = f"fide-render-{len(self._threads)}"
            thread = threading.Thread(target=_work, args=(self._jobs,), name=name, daemon=True)
            self._threads.append(thread)
            _ALL.add(thread)
            thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the threads that wait for a job, and the others after theirs."""
        while cancel_futures:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                break
            if job is not None:
                job[0].cancel()
        for _ in self._threads:
            self._jobs.put(None)
        if wait:
            for thread in self._threads:
                thread.join()


def _work(jobs: SimpleQueue[_Job | None]) -> None:
    while (job := jobs.get()) is not None:
        future, call = job
        if not future.set_running_or_notify_cancel():
            continue
        try:
            result = call()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)
        del job, future, call  # what they hold is not kept while the thread waits


@atexit.register
def _wait_a_little() -> None:
    """Wait for renders that return soon: a thread that is stopped inside of a library may crash."""
    over = time.monotonic() + _GRACE
    for thread in list(_ALL):
        thread.join(max(0.0, over - time.monotonic()))
