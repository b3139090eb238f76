"""The loop of a fit: as many renders under way as there are workers, each told when it arrives.

Nothing waits for a generation.  With several workers the next candidate is asked before the
finished one is told, since telling takes longer: the worker goes on meanwhile.  With one worker the
candidate that is asked knows all that was rendered, so the same seed gives the same fit, which is
that of ``x = opt.ask(1); opt.tell(x, [render(x)])``.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.callbacks import Callbacks, Event
from fide_plugins.fitting.failures import EvaluationError, Extremes, Failures, GivenUpError
from fide_plugins.fitting.pictures import as_told, canonical, shown
from fide_plugins.fitting.rendering import Failed, Outcome, Renderer, Task
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import LOOK, Workers, late
from fide_plugins.recording.record import Record
from fide_plugins.recording.signals import Interrupts
from fide_plugins.types import Float64

__all__ = ["Loop"]

_LONGEST = 86400.0  # seconds of one waiting; the system takes no longer ones than 292 years


class Loop:
    """Asks, renders and tells until a rule says stop.

    record: history of the run, of earlier calls too; what was pending is rendered first.
    interrupts: Ctrl-C and SIGTERM stop the waiting, but no step of the optimizer.
    max_failures: share of the latest renders that may fail, in (0, 1].
    """

    def __init__(
        self,
        optimizer: FIDE,
        renderer: Renderer,
        workers: Workers,
        stopping: Stopping,
        record: Record,
        callbacks: Callbacks,
        timeout: float | None,
        interrupts: Interrupts,
        max_failures: float = 1.0,
    ) -> None:
        self.optimizer, self.record, self.workers = optimizer, record, workers
        self.failures = Failures(record.failures, max_failures)
        self.whole = True
        """Whether record and optimizer agree, so that they may be saved."""
        self.render_seconds = 0.0
        """Sum over the renders of this call's search that gave an image."""
        self.extremes = Extremes(optimizer.views)
        for known in (record.first_image, record.image):
            if known is not None and self.extremes.wanted:
                self.extremes.note(known)
        self._renderer, self._stopping, self._timeout = renderer, stopping, timeout
        self._callbacks, self._interrupts = callbacks, interrupts
        self._running: dict[Task, Float64] = {}
        self._waiting: deque[Float64] = deque([] if record.pending is None else record.pending)
        self._arrived: SimpleQueue[Future[Outcome]] = SimpleQueue()
        self._ahead = workers.number > 1
        self.stopped_by_callback = False
        self._clock = time.perf_counter()
        self.search_began = self.search_ended = self._clock
        """When renders began to be counted, and when no more were, by `time.perf_counter`."""

    @property
    def busy(self) -> int:
        """Renders under way."""
        return len(self._running)

    def over(self) -> str | None:
        """Rule that says that there is nothing to be done; None: none of them."""
        return self._stopping.reached(*self._state(), True, self.optimizer)

    def tick(self) -> None:
        """Enter the seconds since the last call in the record."""
        now = time.perf_counter()
        self.record.wall_s += now - self._clock
        self._clock = now

    def note_learned(self, renders: int) -> None:
        """Enter renders that were learned from before the search, which begins now."""
        self.tick()
        self.record.add_unjudged(renders)
        self.search_began = self._clock

    def step(self) -> str | None:
        """Wait for a render, and tell it; returns why the fit is over, None if it is not.

        Raises GivenUpError, EvaluationError or CallbackError (all FitErrors).
        """
        self._fill()
        if not self._running and not self._goes_on():
            if self._left() == 0.0:  # by now: another call may go on
                return "time"
            raise GivenUpError(
                f"given up: all {self.workers.number} workers hang in a render (those of Dask may "
                "have died), and threads cannot be killed; make render raise when it takes too "
                "long, or take processes"
            )
        task = self._next()
        if task is None:
            self.tick()
            return self._stopping.reached(*self._state(), False, self.optimizer)
        outcome = self._outcome(task)
        if self._ahead:
            self._fill(free=1)
        x = self._running.pop(task)
        improved = self._enter(x, outcome)
        if self.stopped_by_callback:
            return "callback"
        return self._stopping.reached(*self._state(), improved, self.optimizer)

    def pending(self) -> Float64:
        """Candidates (n, dim) that were asked and not told, in that order."""
        return np.array([*self._running.values(), *self._waiting]).reshape(-1, self.optimizer.dim)

    def note_pending(self) -> None:
        """Enter them in the record, so that it may be saved."""
        r = self.record
        r.pending, r.failures = self.pending(), self.failures.count
        del r.generations[:]
        if asked := r.evaluations + len(r.pending):
            r.generations.append(asked)  # one generation that never waits
        self.tick()

    # -- asking ------------------------------------------------------------------------------------

    def _fill(self, free: int = 0) -> None:
        """Give every free worker a candidate; free: finished renders that are not told yet."""
        while len(self._running) - free < self.workers.usable and self._may_ask():
            if not self._waiting:
                self.whole = False
                with self.record.timing(self.optimizer):
                    self._waiting.append(self._candidate())
                self.whole = True
            with self._waiting_for_renders(), self._interrupts.stoppable():
                task = self.workers.submit(self._waiting[0])  # in this process it renders
            self._running[task] = self._waiting.popleft()
            task.add_done_callback(self._arrived.put)

    def _candidate(self) -> Float64:
        """Next candidate (d,); after the first ones have all failed, a random place."""
        if not self._is_lost:
            x: Float64 = self.optimizer.ask(1)[0]
            return x
        number = self.failures.count + len(self._running)
        return self.optimizer.random_point(number)

    @property
    def _is_lost(self) -> bool:
        """Whether no render has given an image so far, and the search cannot say where to go."""
        return not self.record.evaluations and self.failures.tried

    def _goes_on(self) -> bool:
        """Whether renders are under way once a worker is back; there is none now."""
        with self._waiting_for_renders(), self._interrupts.stoppable():
            back = self.workers.comes_back(self._left())
        if back:
            self._fill()
        return bool(self._running)

    def _may_ask(self) -> bool:
        budget, done = self._stopping.budget, self.record.evaluations
        return bool(self._waiting) or budget is None or done + len(self._running) < budget

    # -- waiting -----------------------------------------------------------------------------------

    def _next(self) -> Task | None:
        """A render that is done, or that has taken too long; None: look at the clock."""
        overdue = late(self.workers, self._running, self._timeout)
        if overdue is not None:
            return overdue
        try:
            with self._waiting_for_renders(), self._interrupts.stoppable():
                task = self._arrived.get(timeout=self._patience())
        except Empty:
            return None
        return task if task in self._running else None  # or it was abandoned

    @contextmanager
    def _waiting_for_renders(self) -> Iterator[None]:
        """Count this block as time of rendering: in it the fit does nothing else."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.record.times["render"] += time.perf_counter() - start

    def _patience(self) -> float | None:
        """Seconds to wait at most."""
        limits = [LOOK if self._timeout is not None else None, self._left()]
        given = [limit for limit in limits if limit is not None]
        return min(*given, _LONGEST) if given else None

    def _left(self) -> float | None:
        """Seconds until the fit is over; None: it may take any time."""
        if self._stopping.seconds is None:
            return None
        self.tick()
        return max(0.0, self._stopping.seconds - self.record.wall_s)

    def _outcome(self, task: Task) -> Outcome:
        if task.done():
            return self.workers.outcome(task)
        limit = f"timeout={self._timeout:g} seconds"
        if self.workers.abandon(task):
            return Failed(f"the render took longer than {limit}", broken=True)
        waited = "it may have waited for a worker all the time"
        return Failed(f"no result within {limit}; {waited}", broken=True)

    # -- telling -----------------------------------------------------------------------------------

    def _enter(self, x: Float64, outcome: Outcome) -> bool:
        """Tell the outcome of x (d,), or withdraw it; returns whether it is the best so far.

        Raises GivenUpError if most renders fail, EvaluationError as `_tell` (both FitErrors), and
        ValueRangeError for renders on another scale than the target.
        """
        if isinstance(outcome, Failed):
            self._fail(x, outcome)
            return False
        self.render_seconds += outcome.seconds
        lost = self._is_lost
        try:
            loss = self._tell(x, as_told(self.optimizer, outcome.image))
        except ValueRangeError:  # it is not this render that is wrong, but all of them
            self._waiting.appendleft(x)
            raise
        except ImageError as error:
            self._fail(x, Failed.no_fit(error, outcome.image))
            return False
        if lost:
            self.optimizer.begin_at(x)
        improved = self._note(x, outcome.image, loss)
        if self._callbacks:
            self._call_back(x, outcome.image, loss, improved)
        return improved

    def _tell(self, x: Float64, images: Any) -> float:
        """Tell images of the point x (d,); returns its loss.

        Raises ImageError for those that do not fit, and EvaluationError where the loss or the
        encoder raises.  Both come before anything changes; then x waits to be rendered again.
        """
        self.whole, before = False, self.optimizer.evaluations
        try:
            with self.record.timing(self.optimizer):
                losses = self.optimizer.tell(x[None], images)  # (1,)
        except BaseException as error:
            self.whole = self.optimizer.evaluations == before
            if not self.whole or isinstance(error, ImageError):
                raise
            self._waiting.appendleft(x)
            if not isinstance(error, Exception):
                raise
            raise EvaluationError(
                f"evaluating a render, by the loss and the encoder, raised {error!r}; what was "
                "found until then is the attribute `result` of this error, and a fit with a run "
                "directory goes on with resume=True once the cause is mended"
            ) from error
        return float(losses[0])

    def _note(self, x: Float64, image: Any, loss: float) -> bool:
        """Enter an evaluated candidate in the record; returns whether it is the best so far."""
        self.tick()
        r, best = self.record, self.optimizer.state.best
        if r.first_image is None:
            r.first_image = canonical(self.optimizer, image)
        if self.extremes.wanted:
            self.extremes.note(canonical(self.optimizer, image))
        improved = best is not None and math.isfinite(loss) and loss < r.best_loss
        if improved:
            assert best is not None
            r.best_loss, r.best_evaluation = loss, r.evaluations
            r.x_best, r.image = x, best.solution.image
            r.improvements.append(r.evaluations)
            r.path.append(x.copy())
        r.losses.append(loss)
        r.seconds.append(r.wall_s)
        self.whole = True
        self.failures.note_image()
        return improved

    def _call_back(self, x: Float64, image: Any, loss: float, improved: bool) -> None:
        r = self.record
        event = Event(
            evaluation=r.evaluations - 1,
            x=x,
            loss=loss,
            best_loss=r.best_loss,
            image=shown(self.optimizer, canonical(self.optimizer, image)),
            seconds=r.wall_s,
            busy=self.busy,
            failures=self.failures.count,
            optimizer=self.optimizer,
        )
        stops = self._callbacks.call("on_evaluation", event)
        stops |= improved and self._callbacks.call("on_improvement", event)
        self.stopped_by_callback |= stops

    def _fail(self, x: Float64, failed: Failed) -> None:
        """Withdraw x (d,) and count it; raises GivenUpError if it is time for that."""
        self.optimizer.withdraw(x[None])
        self.failures.note(failed, self._renderer.params(x))
        self.failures.check()

    def _state(self) -> tuple[Sequence[float], float, float]:
        return self.record.losses, self.record.wall_s, self.record.best_loss
