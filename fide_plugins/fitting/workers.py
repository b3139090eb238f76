"""Where renders happen: in this process, in threads, in an executor, in a cluster of Dask.

Processes of our own, each of which can be killed and replaced by itself, are in `processes`.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import replace
from functools import partial
from multiprocessing import current_process
from queue import Empty, SimpleQueue
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar
from weakref import WeakSet

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Failed, Outcome, Portable, Task, unpack
from fide_plugins.runtime.machine import cores
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float64
from fide_plugins.validation.pixels import is_pil, is_torch_tensor

LOOK = 0.25
"""Seconds between two looks at the clocks of renders that may take too long."""


class Workers(Protocol):
    """Renders candidates, several at a time."""

    number: int
    """How many renders run at a time."""

    @property
    def usable(self) -> int:
        """How many of them can render: all but those that hang and cannot be killed."""

    def submit(self, x: Any) -> Task:
        """Render the point x (d,), or whatever the renderer takes."""

    def outcome(self, task: Task) -> Outcome:
        """What a task that is done has given; never raises what went wrong."""

    def began(self, task: Task) -> float | None:
        """Time of `time.monotonic` when the render began; None if it waits for its worker.

        Waiting in a queue is no time of a render.
        """

    def abandon(self, task: Task) -> bool:
        """Stop a render that takes too long; where that is impossible, forget it.

        Returns whether it is known to have begun.
        """

    def comes_back(self, seconds: float | None) -> bool:
        """Whether a worker is usable, perhaps after a while of waiting for those that are not.

        seconds: to wait at most; None: as long as one may take.
        """

    def close(self) -> None:
        """Stop all renders, and give back what was taken for them."""


def late(workers: Workers, tasks: Iterable[Task], timeout: float | None) -> Task | None:
    """First task that is not done `timeout` seconds after its render began; None: there is none.

    timeout: None: a render may take any time.
    """
    if timeout is None:
        return None
    now = time.monotonic()
    for task in tasks:
        began = workers.began(task)
        if began is not None and now - began > timeout and not task.done():
            return task
    return None


class InThisProcess:
    """The process that fits: `submit` returns when the image is there; nothing stops a render."""

    number = 1
    usable = 1

    def __init__(self, renderer: Callable[[Any], Outcome]) -> None:
        self._renderer = renderer

    def submit(self, x: Any) -> Task:
        """Render the point x (d,), or whatever the renderer takes, now."""
        task: Task = Future()
        task.set_result(self._renderer(x))
        return task

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong."""
        return task.result()

    def began(self, task: Task) -> float | None:
        """Time at which it was asked: it is over by then."""
        return time.monotonic()

    def abandon(self, task: Task) -> bool:
        """Nothing to be done: each render is over."""
        return True

    def comes_back(self, seconds: float | None) -> bool:
        """Whether a worker is usable: always."""
        return True

    def close(self) -> None:
        """Nothing was taken."""


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


_RETURNS = 30.0  # seconds in which a worker that has died is there again


class OfExecutor:
    """Workers of an executor.

    number: how many of them to keep busy.
    own: whether the executor is closed with these workers.

    A render in a thread cannot be stopped: after its time-out it is forgotten, and its worker is
    missing until it ends.  So it is with one in a worker of Dask, which renders in a thread, too.
    """

    def __init__(
        self, executor: Executor, renderer: Callable[[Any], Outcome], number: int, own: bool
    ) -> None:
        self.number = number
        self._executor, self._own = executor, own
        self._threads = isinstance(executor, ThreadPoolExecutor | DaemonThreads)
        self._renderer = renderer if self._threads else Portable.of(renderer, number)
        self._clocks: dict[Task, _Clock] = {}
        self._tells = self._threads
        """Whether the executor tells when a render begins."""
        self._alive = 0.0
        """When a render began or ended last, as far as is known."""
        self._hanging: list[Task] = []

    @property
    def usable(self) -> int:
        """How many workers do not hang in a render that was abandoned."""
        self._hanging = [task for task in self._hanging if not task.done()]
        return self.number - len(self._hanging)

    def submit(self, x: Any) -> Task:
        """Render the point x (d,), or whatever the renderer takes."""
        clock = _Clock()
        if self._threads:
            task: Task = self._executor.submit(_noting, clock, self._renderer, x)
        else:
            task = self._executor.submit(self._renderer, x)
        self._clocks[task] = clock
        return task

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong."""
        self._clocks.pop(task, None)
        self._alive = time.monotonic()
        try:
            made = task.result()
        except CancelledError as error:
            return Failed(f"the executor has cancelled it: {error!r}", broken=True)
        except Exception as error:  # of the executor; those of the renderer are outcomes
            return Failed.by(error)
        # from a thread comes what the user's function returned, and bytes of it are no pickle
        return made if self._threads else unpack(made)

    def began(self, task: Task) -> float | None:
        """Time at which it began, not that of waiting in the executor's queue.

        The clock of one that has not begun starts again when another one begins or ends: it runs
        out where all workers of the executor hang.  A `ProcessPoolExecutor` takes one render more
        than it has processes for begun.  Some executors (Dask's) never tell what has begun: there
        it is the time at which it was submitted.
        """
        clock = self._clocks.get(task)
        if clock is None:
            return None
        if clock.began is None and task.running():
            clock.began, self._tells = time.monotonic(), True
        if clock.began is not None:
            self._alive = max(self._alive, clock.began)
            return clock.began
        return max(clock.asked, self._alive) if self._tells else clock.asked

    def abandon(self, task: Task) -> bool:
        """Cancel it, which helps if it has not begun; returns whether it is known to have begun.

        Dask cancels a render that has begun, too, so far as its future goes: that is done at once,
        and the render goes on in its worker.  Left alone, the future is done when the worker is
        free again.
        """
        clock = self._clocks.pop(task, None)
        if not (self._tells and task.cancel()):
            self._hanging.append(task)
        return clock is not None and clock.began is not None

    def comes_back(self, seconds: float | None) -> bool:
        """Whether a worker is usable; where nobody tells what runs, one may have died, and returns.

        Dask starts it again and repeats the render, up to three times: then its future is done.
        It is waited for half a minute, but not longer than so many seconds.
        """
        if not self._tells:
            longest = _RETURNS if seconds is None else min(_RETURNS, seconds)
            wait(self._hanging, longest, return_when=FIRST_COMPLETED)
        return self.usable > 0

    def close(self) -> None:
        """Cancel what has not begun; do not wait for what has."""
        for task in (*self._clocks, *self._hanging):
            task.cancel()
        if self._own:
            self._executor.shutdown(wait=False, cancel_futures=True)


class _Clock:
    def __init__(self) -> None:
        self.asked = time.monotonic()
        self.began: float | None = None


def _noting(clock: _Clock, render: Callable[[Any], Outcome], x: Any) -> Outcome:
    clock.began = time.monotonic()
    outcome = render(x)
    if isinstance(outcome, Failed):
        return outcome
    # the thread gets another candidate before this image is told, and may draw into the same array
    return replace(outcome, image=_copied(outcome.image))


def _copied(image: Any) -> Any:
    if isinstance(image, list | tuple):
        return [_copied(one) for one in image]
    if is_torch_tensor(image):
        return image.detach().clone()
    return image.copy() if isinstance(image, np.ndarray) or is_pil(image) else image


_Renderer: TypeAlias = Callable[[Any], Outcome]

DAEMON = "a daemonic process, such as those of multiprocessing.Pool, cannot start others"
"""Why no process is started in such a process."""
_DEFAULT_MOST = 8  # workers by default: more need more renders for the same loss
_REMEDY = "give executor='threads', or workers=0"


def default_number(executor: object = None) -> int:
    """How many renders run at a time where the user does not say: one a usable core, at most 8.

    An executor renders elsewhere, and threads are for renders that wait: 8 of these.
    """
    return min(cores(), _DEFAULT_MOST) if executor in (None, "processes") else _DEFAULT_MOST


def workers_for(
    renderer: _Renderer, number: int, executor: object, timeout: float | None
) -> Workers:
    """Workers for a renderer; nothing is started yet.

    renderer: an outcome for a point x (d,), or for whatever is submitted.
    number: of renders at a time; 0: in this process.
    executor: None or "processes", "threads", an executor of `concurrent.futures`, or what has a
        method `get_executor`, as Dask's Client.
    timeout: of a render, which this process does not have.
    """
    if number == 0:
        if executor is not None:
            raise OptionError("workers=0 renders in this process: leave out executor")
        if timeout is not None:
            raise OptionError("timeout needs a worker that can be killed: give workers >= 1")
        return InThisProcess(renderer)
    if executor in (None, "processes"):
        return _processes(renderer, number, or_threads=executor is None)
    if executor == "threads":
        return _threads(renderer, number)
    return OfExecutor(_as_executor(executor), renderer, number, own=False)


def _processes(renderer: _Renderer, number: int, or_threads: bool) -> Workers:
    """Processes; where there can be none, threads with a warning, or OptionError."""
    if current_process().daemon:
        if not or_threads:
            raise OptionError(f"{DAEMON}; {_REMEDY}")
        warn_user(f"{DAEMON}, so render runs in threads of this one; to silence this, {_REMEDY}")
        return _threads(renderer, number)
    try:
        return Processes(renderer, number)
    except Exception as error:  # whatever the user's objects raise when they are pickled
        what = f"render cannot be sent to other processes ({type(error).__name__}: {error})"
        if not or_threads:
            raise OptionError(
                f"{what}; make what it needs inside of it, or give executor='threads'"
            ) from error
        warn_user(
            f"{what}, so it runs in threads of this one; to silence this, give "
            "executor='threads', or make what it needs inside of it"
        )
        return _threads(renderer, number)


def _threads(renderer: _Renderer, number: int) -> Workers:
    return OfExecutor(DaemonThreads(number), renderer, number, own=True)


def _as_executor(executor: object) -> Executor:
    if hasattr(executor, "get_executor"):  # Dask's Client; the same point may be rendered twice
        made: Executor = executor.get_executor(pure=False)
        return made
    if isinstance(executor, Executor) or hasattr(executor, "submit"):
        return executor  # type: ignore[return-value]
    raise OptionError(
        "executor must be 'processes', 'threads', an executor of concurrent.futures or Dask's "
        f"Client, not {executor!r}"
    )


def gathered(pool: Workers, X: Float64, limit: float | None) -> Iterator[Outcome]:
    """Outcome of each point of X (n, dim), in order; `pool.number` renders at a time.

    limit: seconds that a render may take, the start of its worker not counted; None: any time.
    """
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
