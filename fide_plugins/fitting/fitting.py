"""A fit that is ready to start or to continue: what its loop asks and tells, and how it ends."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.fitting.around_answer import MOST_NUMBERS, numbers, std_around
from fide_plugins.fitting.callbacks import Callbacks, Event, reporting
from fide_plugins.fitting.failures import (
    CallbackError,
    EvaluationError,
    Failures,
    FitError,
    suspicion_of,
)
from fide_plugins.fitting.fidelity import WorkersAsked
from fide_plugins.fitting.loop import Loop
from fide_plugins.fitting.pictures import as_compared, as_told, canonical, shown
from fide_plugins.fitting.rendering import Failed, Outcome, Renderer, Workers
from fide_plugins.fitting.result import Result, result_from
from fide_plugins.fitting.saved_run import SavedRun, best_pictures, write_later
from fide_plugins.fitting.schedule import Schedule, planned
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import gathered
from fide_plugins.recording.directory import note_unsaved
from fide_plugins.recording.record import Record
from fide_plugins.recording.signals import Interrupted, Interrupts
from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Estimated

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.types import Float64, Solution

_MORE = 10  # one part in so many: renders beyond the budget
_SHOW_INTERVAL = 0.1  # seconds between two reports of a search that goes on


class FitInterrupted(Interrupted):
    """Ctrl-C or SIGTERM stopped the fit; a run directory is saved.

    result: what was computed until then.
    """

    result: Result


@dataclass(eq=False)
class Fitting:
    """A fit; made by `one_call.prepare`; plan: arguments of a `SavedRun`, to save its result."""

    optimizer: FIDE
    renderer: Renderer
    workers: Workers
    stopping: Stopping
    callbacks: Callbacks
    record: Record
    saved: SavedRun | None
    plan: Mapping[str, Any]
    timeout: float | None
    progress: object
    checkpoint_every: float
    max_failures: float
    schedule: Schedule | None

    def __post_init__(self) -> None:
        self._failures = Failures(self.record.failures, self.max_failures)
        self._comparisons = self.optimizer.state.comparisons
        self._done_before = self.record.evaluations
        self._render_seconds = 0.0  # of renders of this call's search that gave an image
        self._shown_at = 0.0
        self._std: Float64 | None = None
        self._std_renders = 0
        self._pool = self.workers
        self._lines: list[str] = [] if self.saved is None else self.saved.lines  # of the plan
        if self.schedule is None:
            return
        if self.record.fineness is None:
            self.schedule.begin()
        else:
            self.schedule.load_state_dict(self.record.fineness)
        self.workers = WorkersAsked(self.workers, self.schedule)
        self.stopping = replace(self.stopping, schedule=self.schedule)

    def execute(self) -> Result:
        """Fit until a rule says stop; raises what `fit` does, after saving what was computed."""
        with (
            nullcontext() if self.saved is None else closing(self.saved),
            Interrupts(once=True) as interrupts,
            reporting(self.progress) as self._report,
        ):
            self._loop = Loop(
                self, self.optimizer, self.workers, self.stopping, self.record, interrupts,
                timeout=self.timeout, checkpoint_every=self.checkpoint_every,
            )  # fmt: skip
            try:
                stopped = self._run(interrupts)
                self._say_how_sure(stopped, interrupts)
            except BaseException as error:
                stopped = "interrupted" if isinstance(error, Interrupted) else "failed"
                return self._end(stopped, interrupts, error)  # which raises it
            finally:
                with suppress(Interrupted), interrupts.unblocked():  # a second signal does not wait
                    self.workers.close()
            return self._end(stopped, interrupts, None)

    def _run(self, interrupts: Interrupts) -> str:
        """Search; returns why the search has ended."""
        loop = self._loop
        loop.stopped = loop.over()
        seconds, schedule = self.stopping.seconds, self.schedule
        if schedule and seconds and not self.record.evaluations and loop.stopped is None:
            with interrupts.stoppable():
                self._lines = planned(schedule, self.optimizer, self._pool, self.timeout, seconds)
            if self._report is not None and sys.stderr is not None:
                lines = [f"plan: {line}\n" for line in self._lines]
                clear = "\r\x1b[K" if sys.stderr.isatty() else ""
                print(clear, *lines, sep="", end="", file=sys.stderr)
        stopped = loop.run()
        if stopped != "callback":
            self._judge()
        return stopped

    def _judge(self) -> None:
        """Render the best candidate as finely as possible, where that was not done."""
        if self.schedule is not None and (X := self.schedule.rise_to_finest()) is not None:
            for outcome in gathered(self.workers, X, self.timeout):
                self.tell(X, outcome)

    def ask(self) -> Float64:
        """Next candidate (1, d); after the first ones have all failed, a random place."""
        if self.schedule is not None and (X := self.schedule.ask()) is not None:
            return X
        if not self._is_lost:
            return self.optimizer.ask(1)
        return self.optimizer.random_point(self._failures.count + self._loop.busy)[None]

    @property
    def _is_lost(self) -> bool:
        """Whether no render has given an image so far, and the search cannot say where to go."""
        return not self.record.evaluations and self._failures.tried

    def tell(self, X: Float64, outcome: Outcome) -> bool:
        """Tell the outcome of X (1, d), or withdraw it; returns whether it is the best so far."""
        if self.schedule is not None:
            answer = self.schedule.received(X[0], outcome)
            if answer == "again":
                self._loop.put_back(X)
            if answer != "tell":
                return False
        if isinstance(outcome, Failed):
            self._withdraw(X, outcome)
            return False
        self._render_seconds += outcome.seconds
        lost = self._is_lost
        try:
            loss = self._evaluate(X, as_told(self.optimizer, outcome.image))
        except ValueRangeError:  # it is not this render that is wrong, but all of them
            self._loop.put_back(X)
            raise
        except ImageError as error:
            self._withdraw(X, Failed.no_fit(error, outcome.image))
            return False
        if lost:
            self.optimizer.begin_at(X[0])
        self._loop.tick()
        r, image = self.record, None
        better = math.isfinite(loss) and loss < r.best_loss
        if better or r.first_image is None or self.callbacks:
            image = canonical(self.optimizer, outcome.image)
        if r.first_image is None:
            r.first_image = as_compared(self.optimizer, outcome.image)
        improved = r.add_one(X[0], image, loss)
        best, changes = self.optimizer.state.best, self.optimizer.state.comparisons
        if best is not None and changes != self._comparisons:
            self._comparisons, improved = changes, False
            r.keep_only(best.solution)
        self._loop.whole = True
        if self.schedule is not None:
            spent, left = self.stopping.spent(r.evaluations, r.wall_s)
            self.schedule.note(X[0], loss, spent=spent, left=left - self._loop.busy)
        self._failures.note_image()
        if self.callbacks:
            self._call_back(X[0], image, loss)
        return improved

    def _withdraw(self, X: Float64, failed: Failed) -> None:
        self.optimizer.withdraw(X)
        self._failures.note(failed, self.renderer.params(X[0]))
        self._failures.check()

    def _evaluate(self, X: Float64, images: Any) -> float:
        """Tell images of the point X (1, d); returns its loss."""
        loop, before = self._loop, self.optimizer.evaluations
        loop.whole = False
        try:
            with self.record.timing(self.optimizer):
                losses = self.optimizer.tell(X, images)  # (1,)
        except BaseException as error:
            loop.whole = self.optimizer.evaluations == before
            if not loop.whole or isinstance(error, ImageError):
                raise
            loop.put_back(X)
            if not isinstance(error, Exception):
                raise
            raise EvaluationError(
                f"evaluating a render, by the loss and the encoder, raised {error!r}; what was "
                "found until then is the attribute `result` of this error, and a fit with a run "
                "directory goes on with resume=True once the cause is mended"
            ) from error
        return float(losses[0])

    def _call_back(self, x: Float64, image: Any, loss: float) -> None:
        event = Event(
            evaluation=self.record.evaluations - 1,
            x=x,
            loss=loss,
            best_loss=self.record.best_loss,
            image=shown(self.optimizer, image),
            seconds=self.record.wall_s,
            busy=self._loop.busy,
            failures=self._failures.count,
            optimizer=self.optimizer,
        )
        if self.callbacks.call("on_evaluation", event):
            self._loop.stopped = "callback"

    def show(self, last: bool) -> None:
        """Report the search; only every so often, unless it is the last time."""
        now = time.perf_counter()
        if self._report is None or (now - self._shown_at < _SHOW_INTERVAL and not last):
            return
        self._shown_at, count = now, self._failures.count
        self._loop.tick()  # a render that failed has not entered its time
        remark = f"{self._loop.busy} rendering" + (f", {count} failed" if count else "")
        at = self.record.progress(self.stopping.budget or 0)
        self._report(replace(at, remark=remark, time=self.stopping.seconds))

    def save(self) -> None:
        """Write a checkpoint, if there is a run directory."""
        if self.saved is not None:
            with self._loop.checkpoints.writing():
                self._note_pending()
                best = best_pictures(self.record, self.optimizer)
                self.saved.save(self.record, self.optimizer, *best)

    def _note_pending(self) -> None:
        """Enter what was asked and not told in the record, so that it may be saved."""
        r = self.record
        r.pending, r.failures = self._loop.pending, self._failures.count
        if self.schedule is not None:
            r.fineness = self.schedule.state_dict()
        self._loop.tick()

    def _say_how_sure(self, stopped: str, interrupts: Interrupts) -> None:
        """Render around the answer, where budget and time have room, for standard deviations."""
        best, done = self.optimizer.state.best, self.record.evaluations
        if best is None or best.solution.image is None or stopped in ("time", "callback"):
            return
        p, rules = len(numbers(self.optimizer)), self.stopping
        need = 1 + 4 * p
        room = math.inf if rules.budget is None else max(rules.budget - done, done // _MORE)
        new = max(1, done - self._done_before)
        each = self._render_seconds / new / max(1, self.workers.number)
        left = math.inf if rules.seconds is None else rules.seconds - self.record.wall_s
        if self.optimizer.state.pixel_noise.variance or not 0 < p <= MOST_NUMBERS:
            return
        if need > room or need * each > left:
            return
        deadline = time.perf_counter() + left
        with suppress(Interrupted, np.linalg.LinAlgError), interrupts.stoppable():
            std, renders = std_around(self.optimizer, self.workers, self.timeout, room, deadline)
            if std is not None:
                self._std, self._std_renders = std, renders

    def _end(self, stopped: str, interrupts: Interrupts, error: BaseException | None) -> Result:
        """Save, and tell the callbacks; raises `error`, or what goes wrong, with the result."""
        interrupts.block()
        try:
            self._write("finished" if error is None else stopped, stopped)
        except Exception as unsaved:
            if error is not None:
                note_unsaved(error, unsaved)
            error = error or unsaved
        result = self._result(stopped)
        if suspicion := suspicion_of(self.optimizer):
            warn_user(suspicion)
        try:
            with interrupts.unblocked():
                self.callbacks.call("on_end", result)
        except (CallbackError, Interrupted) as failed:
            error = error or failed
        if error is not None:
            raise _with_result(error, result)
        return result

    def _write(self, state: str, stopped: str) -> None:
        """Write everything, each file also where another fails; raises the first error of them."""
        saved, record, optimizer = self.saved, self.record, self.optimizer
        if saved is None:
            return
        try:
            if self._loop.whole:
                self.save()
            else:  # in the midst of a step of the optimizer, which cannot be saved
                self._note_pending()
                saved.write_tables(record, *best_pictures(record, optimizer))
        except Exception:
            state = "failed" if state == "finished" else state
            with suppress(Exception):
                saved.leave(state, stopped, record, optimizer, self._solutions, self._lines)
            raise
        saved.leave(state, stopped, record, optimizer, self._solutions, self._lines)

    @cached_property  # of the end: files and result share it, and its standard deviations
    def _solutions(self) -> list[Solution]:
        """Those of the optimizer, the best one with standard deviations by renders around it."""
        solutions = self.optimizer.solutions()
        if self._std is not None:
            best, ambiguous = solutions[0], None
            if best.estimate is not None and len(numbers(self.optimizer)) < self.optimizer.dim:
                ambiguous = best.estimate.ambiguous  # of the others, by samples of the search
            solutions[0] = replace(best, estimate=Estimated(self._std, ambiguous))
        return solutions

    def _result(self, stopped: str) -> Result:
        loop, optimizer, solutions = self._loop, self.optimizer, self._solutions
        self._note_pending()
        searched = max(loop.search_ended - loop.search_began, 1e-9)
        record, validity = self.record if loop.whole else None, optimizer.validity
        return result_from(
            optimizer,
            self.record,
            solutions,
            params=self.renderer.params(solutions[0].x) if solutions else None,
            failures=self._failures.count,
            rejected=None if validity is None else validity.share_rejected,
            first_failure=self._failures.first,
            busy=min(1.0, self._render_seconds / searched / max(1, self.workers.number)),
            stopped=stopped,
            out=None if self.saved is None else self.saved.path,
            std_renders=self._std_renders,
            plan=tuple(self._lines),
            unsaved=partial(
                write_later, optimizer, record, self.plan, stopped, solutions, self._lines
            ),
        )


def _with_result(error: BaseException, result: Result) -> BaseException:
    """The error that ends a fit, with what was computed until then."""
    if isinstance(error, Interrupted):
        stop = FitInterrupted(error.signum)
        stop.result, stop.__suppress_context__ = result, True
        for note in getattr(error, "__notes__", ()):
            stop.add_note(note)
        return stop
    with suppress(AttributeError, TypeError):  # of a class that takes no attributes
        error.result = result  # type: ignore[attr-defined]
        if not isinstance(error, FitError):
            error.add_note("what was found until then is the attribute `result` of this error")
    return error
