"""Where renders happen: in this process, in threads, in an executor; `processes` has our own."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import current_process
from queue import SimpleQueue
from typing import Any, ParamSpec, TypeAlias, TypeVar
from weakref import WeakSet

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Failed, Outcome, Portable, Task, Workers, unpack
from fide_plugins.runtime.machine import cores
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float64
from fide_plugins.validation.images import is_pil, is_torch_tensor

LOOK = 0.25
"""Seconds between two looks at the clocks of renders that may take too long."""

_Renderer: TypeAlias = Callable[[Any], Outcome]
P = ParamSpec("P")
T = TypeVar("T")


def late(workers: Workers, tasks: Iterable[Task], timeout: float | None) -> Task | None:
    """First task that is not done `timeout` seconds after its render began; None: there is none."""
    if timeout is None:
        return None
    now = time.monotonic()
    for task in tasks:
        began = workers.began(task)
        if began is not None and now - began > timeout and not task.done():
            return task
    return None


class InThisProcess(Workers):
    """The process that fits: `submit` returns when the image is there."""

    def __init__(self, renderer: _Renderer) -> None:
        self._renderer = renderer

    def submit(self, x: Any) -> Task:
        """Render it now."""
        task: Task = Future()
        task.set_result(self._renderer(x))
        return task


_GRACE = 1.0  # seconds at the end of the process for renders that are about to return
_THREADS: WeakSet[threading.Thread] = WeakSet()


class DaemonThreads(Executor):
    """Threads that do not keep the process alive, each started with a job until all are there.

    They stay, since a renderer may have made something for its thread, such as a context of OpenGL.
    """

    def __init__(self, number: int) -> None:
        self._number = number
        self._threads: list[threading.Thread] = []
        self._jobs: SimpleQueue[tuple[Any, ...] | None] = SimpleQueue()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call the function as soon as a thread is free."""
        task: Future[T] = Future()
        self._jobs.put((task, partial(fn, *args, **kwargs)))
        if len(self._threads) < self._number:
            thread = threading.Thread(target=_work, args=(self._jobs,), daemon=True)
            self._threads.append(thread)
            _THREADS.add(thread)
            thread.start()
        return task

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the threads after their jobs."""
        for _ in self._threads:
            self._jobs.put(None)


def _work(jobs: SimpleQueue[tuple[Any, ...] | None]) -> None:
    while (job := jobs.get()) is not None:
        task, call = job
        if task.set_running_or_notify_cancel():
            try:
                task.set_result(call())
            except BaseException as error:
                task.set_exception(error)
        del job, task, call  # what they hold is not kept while the thread waits


@atexit.register
def _wait_a_little() -> None:
    """Wait for renders that return soon: a thread that is stopped inside of a library may crash."""
    over = time.monotonic() + _GRACE
    for thread in list(_THREADS):
        thread.join(max(0.0, over - time.monotonic()))


@dataclass
class _Clock:
    asked: float = field(default_factory=time.monotonic)
    began: float | None = None


class OfExecutor(Workers):
    """Workers of an executor; None: threads of this process, which end with them.

    A render in a thread cannot be stopped: after its time-out it is forgotten, and its worker is
    missing until it ends.
    """

    def __init__(self, executor: Executor | None, renderer: _Renderer, number: int) -> None:
        self.number = number
        self._executor: Executor = executor or DaemonThreads(number)
        self._threads = isinstance(self._executor, ThreadPoolExecutor | DaemonThreads)
        self._renderer = renderer if self._threads else Portable.of(renderer)
        self._clocks: dict[Task, _Clock] = {}
        self._alive = 0.0  # when a render began or ended last, as far as is known
        self._hanging: list[Task] = []

    @property
    def usable(self) -> int:
        """How many workers do not hang in a render that was abandoned."""
        self._hanging = [task for task in self._hanging if not task.done()]
        return self.number - len(self._hanging)

    def submit(self, x: Any) -> Task:
        """Render it as soon as a worker is free."""
        clock = _Clock()
        call = partial(_noting, clock, self._renderer) if self._threads else self._renderer
        task: Task = self._executor.submit(call, x)
        self._clocks[task] = clock
        return task

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong."""
        self._clocks.pop(task, None)
        self._alive = time.monotonic()
        try:
            made = task.result()
        except Exception as error:  # of the executor; those of the renderer are outcomes
            return Failed.by(error)
        # from a thread comes what the user's function returned, and bytes of it are no pickle
        return made if self._threads else unpack(made)

    def began(self, task: Task) -> float | None:
        """Time at which it began; if nobody tells, when another one did or ended."""
        clock = self._clocks.get(task)
        if clock is None:
            return None
        if clock.began is None and task.running():
            clock.began = time.monotonic()
        if clock.began is None:
            return max(clock.asked, self._alive)
        self._alive = max(self._alive, clock.began)
        return clock.began

    def abandon(self, task: Task) -> None:
        """Cancel it, which helps if it has not begun."""
        self._clocks.pop(task, None)
        if not task.cancel():
            self._hanging.append(task)

    def close(self) -> None:
        """Cancel what has not begun; do not wait for what has."""
        for task in (*self._clocks, *self._hanging):
            task.cancel()
        if isinstance(self._executor, DaemonThreads):
            self._executor.shutdown()


def _noting(clock: _Clock, render: _Renderer, x: Any) -> Outcome:
    clock.began = time.monotonic()
    outcome = render(x)
    if isinstance(outcome, Failed):
        return outcome
    # the worker gets another candidate before this image is told, and may draw into the same array
    return replace(outcome, image=_copied(outcome.image))


def _copied(image: Any) -> Any:
    if isinstance(image, list | tuple):
        return [_copied(one) for one in image]
    if is_torch_tensor(image):
        return image.detach().clone()
    return image.copy() if isinstance(image, np.ndarray) or is_pil(image) else image


DAEMON = "a daemonic process, such as those of multiprocessing.Pool, cannot start others"
"""Why no process is started in such a process."""
_DEFAULT_MOST = 8  # workers by default: more need more renders for the same loss


def default_number(executor: object = None) -> int:
    """Renders at a time by default: one a usable core, at most 8; elsewhere, or in threads, 8."""
    return min(cores(), _DEFAULT_MOST) if executor in (None, "processes") else _DEFAULT_MOST


def workers_for(
    renderer: _Renderer, number: int, executor: object, timeout: float | None
) -> Workers:
    """Workers for a renderer, of a point x (d,) or of what is submitted; nothing is started yet.

    number: of renders at a time; 0: in this process.  timeout: of a render.
    executor: None or "processes", "threads", one of `concurrent.futures`, or Dask's Client.
    """
    if number == 0:
        if executor is not None:
            raise OptionError("workers=0 renders in this process: leave out executor")
        if timeout is not None:
            raise OptionError("timeout needs a worker that can be killed: give workers >= 1")
        return InThisProcess(renderer)
    if executor == "threads":
        return OfExecutor(None, renderer, number)
    if executor not in (None, "processes"):
        if hasattr(executor, "get_executor"):  # Dask's Client; a point may be rendered twice
            executor = executor.get_executor(pure=False)
        if not isinstance(executor, Executor):
            raise OptionError(
                "executor must be 'processes', 'threads', an executor of concurrent.futures or "
                f"Dask's Client, not {executor!r}"
            )
        return OfExecutor(executor, renderer, number)
    reason = DAEMON
    if not current_process().daemon:
        try:
            return Processes(renderer, number)
        except Exception as error:  # whatever the user's objects raise when they are pickled
            reason = f"render cannot be sent to other processes ({type(error).__name__}: {error})"
    if executor == "processes":
        raise OptionError(f"{reason}; make what it needs inside of it, or give executor='threads'")
    warn_user(
        f"{reason}, so render runs in threads of this one; to silence this, give "
        "executor='threads', or make what it needs inside of it"
    )
    return OfExecutor(None, renderer, number)


def gathered(pool: Workers, X: Float64, limit: float | None) -> Iterator[Outcome]:
    """Outcome of each point of X (n, dim), in order; limit: seconds of a render, None: any."""
    for first in range(0, len(X), pool.number):
        tasks = [pool.submit(x) for x in X[first : first + pool.number]]
        for task in tasks:
            while not task.done() and late(pool, [task], limit) is None:
                wait([task], None if limit is None else LOOK)
            if task.done():
                yield pool.outcome(task)
            else:
                pool.abandon(task)
                reason = f"it did not end within {limit:g} s, its time limit"
                yield Failed(reason, broken=True, killed=True)
