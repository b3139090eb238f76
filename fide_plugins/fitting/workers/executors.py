"""Workers of others: threads, any executor of `concurrent.futures`, Dask."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import replace
from typing import Any

import numpy as np

from fide_plugins.fitting.rendering import Failed, Outcome, Portable, unpack
from fide_plugins.fitting.workers.base import Task
from fide_plugins.fitting.workers.threads import DaemonThreads
from fide_plugins.validation.pixels import is_pil, is_torch_tensor

__all__ = ["OfExecutor"]

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
        """How many workers are not held by a render that was abandoned."""
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

        The clock of one that has not begun starts anew whenever another one begins or ends: it runs
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
    """When a render was asked for, and when it began (`time.monotonic`); None: not known."""

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
