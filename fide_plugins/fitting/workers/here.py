"""Renders in this process, one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from fide_plugins.fitting.rendering import Outcome
from fide_plugins.fitting.workers.base import Task

__all__ = ["Here"]


class Here:
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
