"""Processes of our own that render, each of which can be killed without harm to the others.

Each is a `ProcessPoolExecutor` of one process, a group of its own, started without the script.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError, ProcessPoolExecutor
from contextlib import ExitStack, suppress
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Any

from fide_plugins.fitting.rendering import (
    Failed,
    Outcome,
    Portable,
    Task,
    Workers,
    restored,
    unpack,
)
from fide_plugins.renderers.child import use_folder

_START_LIMIT = 60.0  # seconds to start a worker, after which the clock of its render runs
_STARTING = threading.Lock()


class Processes(Workers):
    """Worker processes, started when they are first needed; raises what pickling raises."""

    def __init__(self, renderer: Callable[[Any], Outcome], number: int) -> None:
        self.number = number
        self._portable = Portable.of(renderer)
        self._workers: list[_Worker] = []
        self._of: dict[Task, _Worker] = {}

    def submit(self, x: Any) -> Task:
        """Render the point x (d,), or whatever the renderer takes, in a free worker."""
        for _ in range(self.number + 1):
            worker = self._free()
            try:
                task = worker.submit(x)
            except BrokenExecutor:  # it was killed while it had nothing to do
                self._remove(worker)
            else:
                self._of[task] = worker
                return task
        raise BrokenExecutor("worker processes end as soon as they start")

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong."""
        worker = self._of.pop(task)
        try:
            return unpack(task.result())
        except (BrokenExecutor, CancelledError) as error:
            end = worker.end()
            self._remove(worker)
            reason = f"its worker process died{end}"
            return Failed(reason, str(error), broken=True, killed=True)
        except Exception as error:
            return Failed.by(error)

    def began(self, task: Task) -> float | None:
        """Time at which its worker was there, at the latest a minute after it was asked."""
        return self._of[task].began()

    def abandon(self, task: Task) -> None:
        """Kill its worker; another one takes its place."""
        self._remove(self._of.pop(task))

    def close(self) -> None:
        """Kill all workers."""
        for worker in self._workers:
            worker.kill()
        self._workers, self._of = [], {}

    def _free(self) -> _Worker:
        busy = {id(worker) for worker in self._of.values()}
        for worker in self._workers:
            if id(worker) not in busy:
                return worker
        self._workers.append(_Worker(self._portable))
        return self._workers[-1]

    def _remove(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.kill()


class _Worker:
    def __init__(self, portable: Portable) -> None:
        self._context = _Context()
        self._ready_at: float | None = None
        self._asked_at = time.monotonic()
        self._folder = tempfile.mkdtemp(prefix="fide-worker-")
        with ExitStack() as failed:
            failed.callback(_remove, self._folder)
            self._executor = ProcessPoolExecutor(
                1, mp_context=self._context, initializer=_begin, initargs=(portable, self._folder)
            )
            failed.callback(self._executor.shutdown, wait=False)
            self._executor.submit(_ready).add_done_callback(self._note_ready)
            _leave_results_to_the_process(self._executor)
            failed.pop_all()

    def _note_ready(self, _: object) -> None:
        self._ready_at = time.monotonic()

    def submit(self, x: Any) -> Task:
        self._asked_at = time.monotonic()
        return self._executor.submit(_render, x)

    def began(self) -> float | None:
        if self._ready_at is not None:
            return max(self._ready_at, self._asked_at)
        limit = self._asked_at + _START_LIMIT
        return limit if time.monotonic() > limit else None

    def end(self) -> str:
        """How a process that has died did so, in words; empty if that is not known."""
        process, code = self._context.started, None
        limit = time.monotonic() + 1.0  # its pipe closes before
        while process is not None and code is None and time.monotonic() < limit:
            process.join(0.01)
            code = process.exitcode
        if code is None or code >= 0:
            return "" if code is None else f" with exit code {code}"
        with suppress(ValueError):
            return f", killed by {signal.Signals(-code).name}"
        return ""

    def kill(self) -> None:
        process = self._context.started
        if process is not None:
            with suppress(ProcessLookupError, PermissionError):
                if hasattr(os, "killpg") and process.pid is not None:
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
        self._executor.shutdown(wait=True, cancel_futures=True)
        _remove(self._folder)


def _remove(folder: str) -> None:
    with suppress(OSError):
        os.rmdir(folder)
    shutil.rmtree(folder, ignore_errors=True)


def _leave_results_to_the_process(executor: ProcessPoolExecutor) -> None:
    """Close our copy of the end of the pipe into which the process writes."""
    # else one that is killed while it sends would leave `shutdown` waiting; there is no public name
    writer = getattr(getattr(executor, "_result_queue", None), "_writer", None)
    if writer is not None:
        writer.close()


class _Context(SpawnContext):
    started: SpawnProcess | None = None

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        self.started = _Process(*args, **kwargs)
        return self.started


class _Process(SpawnProcess):
    """A process that does not import the user's script and never sees Ctrl-C."""

    def start(self) -> None:
        """Start it while the script is out of sight, and SIGINT blocked, which it inherits."""
        blocks = hasattr(signal, "pthread_sigmask")  # not on Windows
        with _STARTING:
            main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else set()
            try:
                super().start()
            finally:
                sys.modules["__main__"] = main
                if blocks:
                    signal.pthread_sigmask(signal.SIG_SETMASK, before)


_PORTABLE: list[Portable] = []


def _begin(portable: Portable, folder: str) -> None:
    _PORTABLE.append(portable)
    use_folder(folder)
    if hasattr(os, "setsid"):  # a group of its own
        with suppress(PermissionError):
            os.setsid()
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()


def _end_with_parent(folder: str) -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        _remove(folder)
        if hasattr(os, "killpg"):
            os.killpg(os.getpgrp(), signal.SIGKILL)
        os._exit(1)


def _ready() -> None:
    """Load the renderer, which is no render's time; the first render reports an error of that."""
    with suppress(Exception, SystemExit):
        restored(_PORTABLE[0].payload)


def _render(x: Any) -> Outcome:
    return _PORTABLE[0](x)
