"""Workers of others: threads, any executor of `concurrent.futures`, Dask."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor

from fide_plugins.fitting.rendering import Failed, Outcome, Portable, Renderer, unpack
from fide_plugins.fitting.workers.base import Task
from fide_plugins.types import Float64

__all__ = ["OfExecutor"]


class OfExecutor:
    """Workers of an executor.

    number: how many of them to keep busy.
    own: whether the executor is closed with these workers.

    A render in a thread cannot be stopped: after its time-out it is forgotten, and its worker is
    missing until it ends.
    """

    def __init__(self, executor: Executor, renderer: Renderer, number: int, own: bool) -> None:
        threads = isinstance(executor, ThreadPoolExecutor)
        self.number = number
        self._executor, self._own = executor, own
        self._render: Callable[[Float64], Outcome] = renderer if threads else Portable.of(renderer)
        self._began: dict[Task, float] = {}
        self._hanging: list[Task] = []

    @property
    def usable(self) -> int:
        """How many workers are not held by a render that was abandoned."""
        self._hanging = [task for task in self._hanging if not task.done()]
        return self.number - len(self._hanging)

    def submit(self, x: Float64) -> Task:
        """Render the point x (d,)."""
        task: Task = self._executor.submit(self._render, x)
        self._began[task] = time.monotonic()
        return task

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong."""
        self._began.pop(task, None)
        try:
            made = task.result()
        except CancelledError as error:
            return Failed(f"the executor has cancelled it: {error!r}")
        except Exception as error:  # of the executor; those of the renderer are outcomes
            return Failed.by(error)
        # from a thread comes what the user's function returned, and bytes of it are no pickle
        return unpack(made) if isinstance(self._render, Portable) else made

    def began(self, task: Task) -> float | None:
        """Time at which it was submitted: no more are than there are workers."""
        return self._began.get(task)

    def abandon(self, task: Task) -> None:
        """Cancel it, which helps if it has not begun."""
        self._began.pop(task, None)
        if not task.cancel():
            self._hanging.append(task)

    def close(self) -> None:
        """Cancel what has not begun; do not wait for what has."""
        for task in self._began:
            task.cancel()
        if self._own:
            self._executor.shutdown(wait=False, cancel_futures=True)
