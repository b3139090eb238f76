"""The loop of `fit` and of the runs of the lab: ask, render, tell, record, until a rule says stop.

With one worker, the same seed gives the fit of ``x = opt.ask(1); opt.tell(x, [render(x)])``.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from queue import Empty, SimpleQueue
from typing import Any, Protocol

import numpy as np

from fide_plugins.fitting.failures import GivenUpError
from fide_plugins.fitting.rendering import Failed, Task, Workers
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import LOOK, late
from fide_plugins.recording.directory import CheckpointTimer
from fide_plugins.recording.record import Record
from fide_plugins.recording.signals import Interrupts
from fide_plugins.types import Float64, Optimizer

_LONGEST = 86400.0  # seconds of one waiting; the system takes no longer ones than 292 years


class Steps(Protocol):
    """What a loop does: that of a fit, or that of a run of the lab."""

    def ask(self) -> Float64:
        """Next candidates (n, dim), n >= 1."""

    def tell(self, X: Float64, outcome: Any) -> bool:
        """Tell and record what was rendered; whether it holds the best loss so far."""

    def show(self, last: bool) -> None:
        """Report the progress."""

    def save(self) -> None:
        """Write a checkpoint, if there is a run directory."""


@dataclass(eq=False)
class Loop:
    """Asks, renders, tells and records until a rule says stop.

    record: of earlier calls, too; what was pending is rendered first.
    interrupts: Ctrl-C and SIGTERM stop the waiting, but no step of the optimizer.
    piece: most candidates that are rendered together, as X (n, dim); None: each as x (dim,).

    whole: whether record and optimizer agree, so that they may be saved.
    stopped: why the run ends, where its steps say so.
    search_began, search_ended: when renders began and ceased to count, by `time.perf_counter`.
    """

    steps: Steps
    optimizer: Optimizer
    workers: Workers
    stopping: Stopping
    record: Record
    interrupts: Interrupts
    _: KW_ONLY
    timeout: float | None = None
    piece: int | None = None
    checkpoint_every: float = 5.0

    def __post_init__(self) -> None:
        self.stopped: str | None = None
        self.whole = True
        self._running: dict[Task, Float64] = {}
        pending = self.record.pending
        self._waiting: deque[Float64] = deque([] if pending is None else pending)
        self._arrived: SimpleQueue[Task] = SimpleQueue()
        self.checkpoints = CheckpointTimer(self.checkpoint_every)
        self._clock = time.perf_counter()
        self.search_began = self.search_ended = self._clock

    def run(self) -> str:
        """Search until a rule says stop; returns its name."""
        stopped = self.over()
        self.steps.show(last=stopped is not None)  # from where the speed counts
        try:
            while stopped is None:
                stopped = self._step()
                self.steps.show(last=stopped is not None)
                if self.checkpoints.due():
                    self.steps.save()
                self.interrupts.check()
        finally:
            self.search_ended = time.perf_counter()
        return stopped

    @property
    def busy(self) -> int:
        """Renders under way."""
        return len(self._running)

    @property
    def pending(self) -> Float64:
        """Candidates (n, dim) that were asked and not told, in that order."""
        running = [x for X in self._running.values() for x in X]
        return np.array([*running, *self._waiting]).reshape(-1, self.optimizer.dim)

    def over(self, improved: bool = True) -> str | None:
        """Rule that says that there is nothing to be done; None: none of them."""
        r = self.record
        if self.stopped is not None:
            return self.stopped
        fide: Any = self.optimizer  # of another one only the budget is asked
        return self.stopping.reached(r.losses, r.wall_s, r.best_loss, improved, fide)

    def put_back(self, X: Float64) -> None:
        """Render candidates (n, dim) again that could not be told."""
        self._waiting.extendleft(X[::-1])

    def tick(self) -> None:
        """Enter the seconds since the last call in the record."""
        now = time.perf_counter()
        self.record.wall_s += now - self._clock
        self._clock = now

    @contextmanager
    def not_counted(self) -> Iterator[None]:
        """Count this block as no time of the run."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._clock += time.perf_counter() - start

    @contextmanager
    def _rendering(self) -> Iterator[None]:
        start = time.perf_counter()
        try:
            with self.interrupts.stoppable():
                yield
        finally:
            self.record.times["render"] += time.perf_counter() - start

    def _step(self) -> str | None:
        """Wait for a render, and tell it; returns why the run is over, None if it is not."""
        self._fill()
        if not self._running:
            raise GivenUpError(
                f"given up: all {self.workers.number} workers hang in a render, and threads cannot "
                "be killed; make render raise when it takes too long, or take processes"
            )
        task = self._next()
        if task is None:
            self.tick()
            return self.over(improved=False)
        outcome = self._outcome(task)
        if self.workers.number > 1:
            self._fill(free=1)
        return self.over(self.steps.tell(self._running.pop(task), outcome))

    def _fill(self, free: int = 0) -> None:
        """Give every free worker candidates; free: finished renders that are not told yet."""
        budget = self.stopping.budget or math.inf
        while len(self._running) - free < self.workers.usable:
            if not self._waiting and self.record.evaluations + len(self._running) >= budget:
                return
            if not self._waiting:
                self._ask()
            X = np.array([self._waiting[i] for i in range(self._together())])
            with self._rendering():  # where it renders in this process
                task = self.workers.submit(X[0] if self.piece is None else X)
            for _ in X:
                self._waiting.popleft()
            self._running[task] = X
            task.add_done_callback(self._arrived.put)

    def _ask(self) -> None:
        self.whole = False
        with self.record.timing(self.optimizer):
            self._waiting.extend(self.steps.ask())
        self.whole = True

    def _together(self) -> int:
        """How many of the waiting candidates are rendered next, as far as the budget allows."""
        left = (self.stopping.budget or math.inf) - self.record.evaluations
        return int(min(self.piece or 1, max(1, left), len(self._waiting)))

    def _next(self) -> Task | None:
        """A render that is done, or that has taken too long; None: look at the clock."""
        overdue = late(self.workers, self._running, self.timeout)
        if overdue is not None:
            return overdue
        limits = [LOOK if self.timeout is not None else None, self._left()]
        given = [limit for limit in limits if limit is not None]
        try:
            with self._rendering():
                task = self._arrived.get(timeout=min(*given, _LONGEST) if given else None)
        except Empty:
            return None
        return task if task in self._running else None  # or it was abandoned

    def _left(self) -> float | None:
        """Seconds until the run is over; None: it may take any time."""
        if self.stopping.seconds is None:
            return None
        self.tick()
        return max(0.0, self.stopping.seconds - self.record.wall_s)

    def _outcome(self, task: Task) -> Any:
        if task.done():
            return self.workers.outcome(task)
        limit = f"timeout={self.timeout:g} seconds"
        self.workers.abandon(task)
        return Failed(f"the render took longer than {limit}", broken=True)
