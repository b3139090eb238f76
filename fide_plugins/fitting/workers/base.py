"""What a set of workers is."""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any, Protocol, TypeAlias

from fide_plugins.fitting.rendering import Outcome

__all__ = ["LOOK", "Task", "Workers", "late"]

LOOK = 0.25
"""Seconds between two looks at the clocks of renders that may take too long."""

Task: TypeAlias = "Future[Outcome]"
"""A render that was begun, or will be as soon as a worker is free."""


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
