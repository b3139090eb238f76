"""A fit that is ready to start or to continue: its loop, saved by time, and how it ends."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import closing, nullcontext, suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.fitting.around_answer import MOST_NUMBERS, numbers, std_around
from fide_plugins.fitting.callbacks import Callbacks, Run, reporting
from fide_plugins.fitting.failures import CallbackError, FitError, suspicion_of
from fide_plugins.fitting.loop import Loop
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Renderer
from fide_plugins.fitting.result import Result, histories
from fide_plugins.fitting.saved_run import SavedRun, Unsaved
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import Workers
from fide_plugins.recording.directory import CheckpointTimer, note_unsaved
from fide_plugins.recording.record import Record, Report
from fide_plugins.recording.signals import Interrupted, Interrupts
from fide_plugins.runtime.messages import warn_user
from fide_plugins.uncertainty.at_answer import AtAnswer

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.learning.hypotheses import Rounds
    from fide_plugins.types import Float64, Solution

__all__ = ["FitInterrupted", "Fitting"]

_MORE = 10  # one part in so many: renders beyond the budget
_SHOW_INTERVAL = 0.1  # seconds between two reports of a search that goes on


class FitInterrupted(Interrupted):
    """Ctrl-C or SIGTERM stopped the fit; a run directory is saved.

    result: what was computed until then.
    """

    result: Result


class Fitting:
    """A fit; made by `one_call.prepare`.

    plan: arguments of a `SavedRun`, with which its result can be saved.
    """

    def __init__(
        self,
        optimizer: FIDE,
        renderer: Renderer,
        workers: Workers,
        stopping: Stopping,
        callbacks: Callbacks,
        record: Record | None = None,
        saved: SavedRun | None = None,
        *,
        timeout: float | None = None,
        progress: object = None,
        checkpoint_every: float = 5.0,
        rounds: Rounds | None = None,
        plan: Mapping[str, Any] | None = None,
        max_failures: float = 1.0,
    ) -> None:
        self._rounds, self._plan, self._max_failures = rounds, plan or {}, max_failures
        self.optimizer, self.record, self.saved = optimizer, record or Record(), saved
        self._renderer, self._workers, self._stopping = renderer, workers, stopping
        self._callbacks, self._timeout, self._progress = callbacks, timeout, progress
        self._checkpoint_every = checkpoint_every
        self._shown_at = 0.0
        self._std: Float64 | None = None
        self._std_renders = self._done_before = 0

    def execute(self) -> Result:
        """Fit until a rule says stop.

        Raises FitInterrupted (a KeyboardInterrupt) after SIGINT or SIGTERM, FitError if hardly any
        render succeeds or a callback, the loss or the encoder raises, any error of the optimizer,
        OSError if the run directory cannot be written.  What was computed is saved before, as far
        as that can be done, and is the attribute `result` of whatever is raised.
        """
        with (
            nullcontext() if self.saved is None else closing(self.saved),
            Interrupts(once=True) as interrupts,
            reporting(self._progress) as report,
        ):
            self._loop = Loop(
                self.optimizer,
                self._renderer,
                self._workers,
                self._stopping,
                self.record,
                self._callbacks,
                self._timeout,
                interrupts,
                self._max_failures,
            )
            self._checkpoints = CheckpointTimer(self._checkpoint_every)
            try:
                stopped = self._run(interrupts, report)
                self._say_how_sure(stopped, interrupts)
            except BaseException as error:
                stopped = "interrupted" if isinstance(error, Interrupted) else "failed"
                return self._end(stopped, interrupts, error)  # which raises it
            finally:
                self._stop_workers(interrupts)
            return self._end(stopped, interrupts, None)

    def _run(self, interrupts: Interrupts, report: Report | None) -> str:
        """The loop; returns why it has ended."""
        loop = self._loop
        self._done_before = self.record.evaluations
        stopped = loop.over()
        if stopped is None and self._callbacks.call("on_start", self._as_run()):
            stopped = "callback"
        if stopped is None and self._rounds is not None:
            if not self.record.evaluations:
                self._learn(self._rounds, interrupts, report)
            self._rounds.remove_renders()  # also where an earlier call was killed before that
        self._show(report, last=stopped is not None)  # from where the speed counts
        try:
            while stopped is None:
                stopped = loop.step()
                self._show(report, last=stopped is not None)
                self._save_if_due()
                interrupts.check()
        finally:
            loop.search_ended = time.perf_counter()
        return stopped

    def _learn(self, rounds: Rounds, interrupts: Interrupts, report: Report | None) -> None:
        """Learn before the search, which then begins with the model."""

        def show(renders: int, doing: str) -> None:
            self._loop.tick()
            if report is not None:
                at = self.record.progress(self._stopping.budget or 0)
                report(replace(at, evaluations=renders, doing=doing))

        workers = self._workers.number if isinstance(self._workers, Processes) else 1
        with interrupts.stoppable():
            learned = rounds.learn(workers, show)
        self.optimizer.begin_with(learned.model, learned.renders)
        self._loop.note_learned(learned.renders)
        if self.saved is not None:
            self._save(self.saved)

    def _say_how_sure(self, stopped: str, interrupts: Interrupts) -> None:
        """Standard deviations (dim,) from renders around the answer, as far as these can be made.

        They are made where the budget has room, or where they add at most a tenth, and where the
        time has room.  A signal meanwhile ends them, and the fit ends as it would have.
        """
        best, done = self.optimizer.state.best, self.record.evaluations
        if best is None or best.solution.image is None or stopped in ("time", "callback"):
            return
        p, rules = len(numbers(self.optimizer)), self._stopping
        need = 1 + 4 * p
        room = math.inf if rules.budget is None else max(rules.budget - done, done // _MORE)
        new = max(1, done - self._done_before)
        each = self._loop.render_seconds / new / max(1, self._workers.number)
        left = math.inf if rules.seconds is None else rules.seconds - self.record.wall_s
        if self.optimizer.state.grain.variance or not 0 < p <= MOST_NUMBERS:
            return
        if need > room or need * each > left:
            return
        deadline = time.perf_counter() + left
        with suppress(Interrupted, np.linalg.LinAlgError), interrupts.stoppable():
            std, renders = std_around(self.optimizer, self._workers, self._timeout, room, deadline)
            if std is not None:
                self._std, self._std_renders = std, renders

    # -- ending ------------------------------------------------------------------------------------

    def _end(self, stopped: str, interrupts: Interrupts, error: BaseException | None) -> Result:
        """Save, and tell the callbacks; raises `error`, or what goes wrong here, with the result.

        No signal stops the writing.
        """
        interrupts.hold()
        try:
            self._write("finished" if error is None else stopped, stopped)
        except Exception as unsaved:
            if error is not None:
                note_unsaved(error, unsaved)
            error = error or unsaved
        result = self._result(stopped)
        if suspicion := suspicion_of(self.optimizer, self._loop.extremes):
            warn_user(suspicion)
        try:
            with interrupts.let_go():
                self._callbacks.call("on_end", result)
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
                self._save(saved)
            else:  # in the midst of a step of the optimizer, which cannot be saved
                self._loop.note_pending()
                saved.write_tables(record, optimizer)
        except Exception:
            with suppress(Exception):
                failed = "failed" if state == "finished" else state
                saved.leave(failed, stopped, record, optimizer, self._solutions)
            raise
        saved.leave(state, stopped, record, optimizer, self._solutions)

    def _stop_workers(self, interrupts: Interrupts) -> None:
        """Stop them; a second signal does not wait for that."""
        with suppress(Interrupted), interrupts.let_go():
            self._workers.close()

    @cached_property  # of the end: files and result share it, and its standard deviations
    def _solutions(self) -> list[Solution]:
        """Those of the optimizer, the best one with standard deviations by renders around it."""
        solutions = self.optimizer.solutions()
        if self._std is not None:
            best = solutions[0]
            solutions[0] = replace(best, estimate=AtAnswer(self._std, best.estimate))
        return solutions

    def _result(self, stopped: str) -> Result:
        r, loop = self.record, self._loop
        solutions = self._solutions
        best = solutions[0] if solutions else None
        validity = self.optimizer.validity
        loop.note_pending()
        searched = max(loop.search_ended - loop.search_began, 1e-9)
        workers = max(1, self._workers.number)
        return Result(
            best=best,
            params=None if best is None else self._renderer.params(best.x),
            solutions=solutions,
            status=self.optimizer.status,
            target=self.optimizer.target,
            weights=self.optimizer.weights,
            loss=self.optimizer.evaluator.loss.name,
            failures=loop.failures.count,
            rejected=None if validity is None else validity.share_rejected,
            first_failure=loop.failures.first,
            busy=min(1.0, loop.render_seconds / searched / workers),
            stopped=stopped,
            out=None if self.saved is None else self.saved.path,
            clipped=self.optimizer.clipped,
            value_range=self.optimizer.value_range,
            std_renders=self._std_renders,
            unsaved=Unsaved(
                self.optimizer, r if loop.whole else None, self._plan, stopped, solutions
            ),
            **histories(r, self.optimizer.dim),
        )

    # -- meanwhile ---------------------------------------------------------------------------------

    def _as_run(self) -> Run:
        out = None if self.saved is None else self.saved.path
        budget, done = self._stopping.budget, self.record.evaluations
        return Run(self.optimizer, self._workers.number, budget, done, out)

    def _show(self, report: Report | None, last: bool) -> None:
        """Report the search; only every so often, unless it is the last time."""
        now = time.perf_counter()
        if report is None or (now - self._shown_at < _SHOW_INTERVAL and not last):
            return
        self._shown_at, loop = now, self._loop
        loop.tick()  # a render that failed has not entered its time
        failed = f", {loop.failures.count} failed" if loop.failures.count else ""
        at = self.record.progress(self._stopping.budget or 0)
        report(replace(at, remark=f"{loop.busy} rendering{failed}", time=self._stopping.seconds))

    def _save_if_due(self) -> None:
        if self.saved is not None and self._checkpoints.due(self.optimizer):
            self._save(self.saved)

    def _save(self, saved: SavedRun) -> None:
        with self._checkpoints.writing():
            self._loop.note_pending()
            saved.save(self.record, self.optimizer)


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
