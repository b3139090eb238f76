"""Work items in several processes of this machine; a process that dies loses only its own item.

Each process is a pool with one worker, so that a death can be attributed to its item.  Each has
its own process group: Ctrl-C reaches only this process, which tells the others to save and stop.
A process whose parent has ended stops by itself.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

__all__ = ["in_processes"]

Lost = Callable[[Any], Any]


def in_processes(
    work: Callable[[Any], Any], items: Sequence[Any], jobs: int, lost: Lost
) -> Iterator[Any]:
    """Results of `work` for all items by `jobs` processes, in order of completion.

    work: a function that can be pickled.
    lost: gives the result for an item whose process died.

    When the iterator is closed, or an exception is raised into it, the processes are told to stop.
    Results that still arrive are dropped: the work has written them to files.
    """
    waiting, workers = list(reversed(items)), [_Worker() for _ in range(min(jobs, len(items)))]
    running: dict[Future[Any], tuple[_Worker, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < len(workers):
                idle = next(
                    w for w in workers if all(w is not busy for busy, _ in running.values())
                )
                item = waiting.pop()
                running[idle.submit(work, item)] = idle, item
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                worker, item = running.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    worker.restart()
                    result = lost(item)
                yield result
    finally:
        _stop(workers)


def _stop(workers: Sequence[_Worker]) -> None:
    """Tell all workers to save and stop, and wait for them; a second Ctrl-C does not wait."""
    try:
        for worker in workers:
            worker.signal(signal.SIGTERM)
        for worker in workers:
            worker.join()
    except BaseException:
        for worker in workers:
            worker.signal(getattr(signal, "SIGKILL", signal.SIGTERM))
        raise


class _Worker:
    """One process."""

    def __init__(self) -> None:
        self._pool, self._pid = _pool(), 0

    def submit(self, work: Callable[[Any], Any], item: Any) -> Future[Any]:
        """Start `work` on an item; where no process starts, its future has the error."""
        try:
            return self._submit(work, item)
        except BrokenProcessPool:  # the process died while it was idle
            self.restart()
        try:
            return self._submit(work, item)
        except BrokenProcessPool as error:
            failed: Future[Any] = Future()
            failed.set_exception(error)
            return failed

    def _submit(self, work: Callable[[Any], Any], item: Any) -> Future[Any]:
        self._pid = self._pid or self._pool.submit(os.getpid).result()  # for `signal`
        return self._pool.submit(_busy, work, item)

    def restart(self) -> None:
        """Replace the process after it died."""
        self._pool.shutdown(wait=False)
        self._pool, self._pid = _pool(), 0

    def signal(self, signum: int) -> None:
        """Send a signal to the process."""
        if self._pid:
            with suppress(ProcessLookupError):
                os.kill(self._pid, signum)

    def join(self) -> None:
        """Wait until the process has ended."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _pool() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, initializer=_begin)


_AT_WORK = threading.Lock()


def _busy(work: Callable[[Any], Any], item: Any) -> Any:
    with _AT_WORK:
        return work(item)


def _begin() -> None:
    """In a new process: leave the terminal's process group, and end when the parent ends."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)  # the work in progress saves its state and stops
    with _AT_WORK:
        os._exit(1)
