"""A run of a task by the loop of `fit`: generations, in pieces, until the budget is spent.

Resuming gives the result of an uninterrupted run, bit for bit: the state is saved only between
pieces, with the pending candidates, and each evaluation of a noisy renderer has its own seed.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fide_lab.figures import Panel
from fide_lab.run.foreign import ERROR, Foreign
from fide_lab.run.result import RunResult, Verdict, result_of
from fide_lab.run.task import Task, TaskInfo
from fide_plugins import losses as losses_module
from fide_plugins.errors import FideError, PointsError, RenderError
from fide_plugins.fitting.loop import Loop
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import InThisProcess
from fide_plugins.losses.base import ImageLoss
from fide_plugins.recording.directory import RunDirectory, note_unsaved
from fide_plugins.recording.record import Progress, Record, Report
from fide_plugins.recording.signals import Interrupted, Interrupts
from fide_plugins.recording.storage import CHECKPOINT, TARGET_FILE
from fide_plugins.types import Float32, Float64, Optimizer
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.points import as_points
from fide_plugins.validation.values import Clipping

PIECE = 32
"""Candidates rendered before their results are told, unless the task says another number.  It is
fixed, for another one changes the last bits of features that are computed in batches."""


@dataclass(frozen=True)
class Keep:
    """What a run records in addition to the losses; none of it counts as time of the run.

    metrics: names of losses that also measure every image that improves on the best loss.
    summary: a figure of the whole run, summary.png.
    checkpoint: whether to keep the checkpoint of a finished run.
    """

    metrics: tuple[str, ...] = ()
    summary: bool = True
    checkpoint: bool = True


class Run:
    """A run that is ready to start or to continue; made by `prepare`, which checks everything.

    task, target: scene, and the picture to find (H, W, 3).
    optimizer, loss: what asks for candidates, and what judges their images.
    settings: what defines the run, as `run.json` records it.
    record: history so far.
    directory: run directory, or None.
    checkpoint_every: seconds between checkpoints, see `CheckpointTimer`.
    keep, metrics: what to record beside the loss, and the losses that this needs, by name.
    """

    def __init__(
        self,
        task: Task,
        target: Float32,
        optimizer: Optimizer,
        loss: ImageLoss,
        settings: dict[str, Any],
        record: Record,
        directory: RunDirectory | None,
        checkpoint_every: float,
        keep: Keep,
        metrics: Mapping[str, ImageLoss],
    ) -> None:
        self.task, self.target, self.optimizer, self.loss = task, target, optimizer, loss
        self.settings, self.record = settings, record
        self._directory, self._checkpoint_every = directory, checkpoint_every
        self._keep, self._metrics = keep, metrics
        self._info = TaskInfo.of(task)
        self._budget: int = settings["budget"]
        self._clipping = Clipping()
        self._foreign: Foreign | None = None
        if self._info.error is not None:
            self._foreign = Foreign(self._info, target, settings["loss"], optimizer)

    @property
    def out(self) -> Path | None:
        """Run directory, if there is one."""
        return None if self._directory is None else self._directory.path

    @property
    def progress(self) -> Progress:
        """Progress of the run."""
        return self.record.progress(self._budget)

    def execute(self, on_progress: Report | None = None) -> RunResult:
        """Run until the budget is spent.

        on_progress: called with what is known, at the start and after each piece; None: never.

        Raises Interrupted (a KeyboardInterrupt) after SIGINT or SIGTERM, RenderError if the
        renderer fails, any error of the optimizer, OSError if the directory cannot be written.  In
        all these cases the state is saved first if it is consistent.
        """
        self._on_progress = on_progress
        directory = nullcontext() if self._directory is None else closing(self._directory)
        with directory, Interrupts(once=True) as interrupts:
            self._loop = Loop(
                self, self.optimizer, InThisProcess(self._render),
                Stopping(self._budget, until="budget"), self.record, interrupts,
                piece=self._info.piece or PIECE, checkpoint_every=self._checkpoint_every,
            )  # fmt: skip
            try:
                self._loop.run()
                self.save()
                with interrupts.stoppable(), self._loop.not_counted():
                    verdict = self._judge()
            except Interrupted:
                self._leave("interrupted")
                raise
            except BaseException as error:
                interrupts.block()
                try:
                    self._leave("failed")
                except Exception as unsaved:  # of the disk, or of a user's optimizer
                    note_unsaved(error, unsaved)
                raise
            interrupts.block()
            result = self._result(verdict)
            if self._directory is not None:
                if result.noisy:
                    self._directory.write_image("reference", result.reference)
                if self._keep.summary:
                    self._write_summary(result)
                self._directory.write_run("finished", result.totals())
                if not self._keep.checkpoint:
                    folder = self._directory.path
                    files = [folder / CHECKPOINT, folder / TARGET_FILE]
                    for file in [*files, *folder.glob("optimizer-*.ckpt")]:
                        with suppress(OSError):
                            file.unlink()
            return result

    # -- steps of the loop -------------------------------------------------------------------------

    def ask(self) -> Float64:
        """Next generation (n, dim), or one step; PointsError if it breaks the protocol."""
        return self._points(self.optimizer.ask_ready(), "asked for impossible candidates")

    def tell(self, X: Float64, images: Any) -> bool:
        """Evaluate, tell and record a piece X (n, dim) with its images."""
        record, start = self.record, time.perf_counter()
        if self._foreign is not None:
            self._loop.whole = False
            batch, losses = self._foreign.tell(self.optimizer, X, images, record)
        else:
            try:
                batch = as_batch(images, self.target.shape, n=len(X), on_clip=self._clipping)
                losses = self.loss.compute(batch)
            except BaseException:
                self._loop.put_back(X)
                raise
            record.times["encode"] += time.perf_counter() - start
            self._loop.whole = False
            with record.timing(self.optimizer):
                self.optimizer.tell(X, batch, losses)
        self._loop.tick()
        improved = record.add(X, batch, losses)
        with self._loop.not_counted():
            if self._foreign is not None:
                self._foreign.note_errors(record)
            for name, metric in self._metrics.items():
                values = record.metrics.setdefault(name, array("d"))
                if improved:
                    values.extend(metric.compute(batch[improved]).tolist())
        self._loop.whole = True
        return bool(improved)

    def show(self, last: bool) -> None:
        """Report the progress; last: whether the run is over."""
        if self._on_progress is not None:
            self._on_progress(self.progress)

    def save(self) -> None:
        """Write a checkpoint and the tables, if there is a run directory."""
        self._loop.tick()  # the optimizer's last step may be in `times` alone
        with self._loop.checkpoints.writing():
            if self._directory is not None:
                self.record.pending = self._loop.pending
                self._directory.save(self.record, self.optimizer, self.record.image)
                self._directory.write_target(self.target)
        self._loop.tick()

    # -- rendering ---------------------------------------------------------------------------------

    def _render(self, X: Float64) -> Any:
        done = self.record.evaluations
        first = self.settings["seed"] * 2**40 + done
        with self._named(f"failed to render candidates {done} to {done + len(X) - 1}"):
            return self.task.render(X, seed=[first + i for i in range(len(X))])

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Errors that the task raises become a RenderError that says what it did."""
        try:
            yield
        except FideError:
            raise
        except Exception as error:
            raise RenderError(f"{self.settings['task']} {what}: {error!r}") from error

    # -- ending ------------------------------------------------------------------------------------

    def _leave(self, state: str) -> None:
        """Save a consistent state, or all but that, before an exception is raised on."""
        if self._directory is None:
            return
        r = self.record
        if self._loop.whole:
            self.save()
        else:
            with suppress(Exception):  # of a record that is not whole; the totals matter more
                self._directory.write_tables(r, r.image)
                self._directory.write_target(self.target)
        result = self._result(judge(None, self.target, self.loss, r.x_best, r.image))
        self._directory.write_run(state, result.totals())
        if state == "interrupted" and self._keep.summary and r.evaluations:
            self._write_summary(result)

    def _write_summary(self, result: RunResult) -> None:
        assert self._directory is not None
        more = []
        if result.noisy and result.reference is not None:
            more = [Panel("reference", result.reference, f"MSE {result.mse:.3g}")]
        pictures = self.target, result.first_image, result.image
        self._directory.write_summary(self.record, *pictures, more=more)

    def _judge(self) -> Verdict:
        r, reference = self.record, self._info.reference
        recommended = None
        if r.x_best is not None:
            said = np.asarray(self.optimizer.recommend())[None]
            recommended = np.asarray(self._points(said, "recommended an impossible point")[0])
        with self._named("failed to judge the result"):
            verdict = judge(
                reference, self.target, self.loss, r.x_best, r.image, recommended, self._metrics
            )
            if self._foreign is not None and r.x_best is not None:
                verdict.metrics[ERROR] = self._foreign.error(r.x_best)
                return replace(verdict, loss=r.best_loss)  # by another comparison than `judge`
            return verdict

    def _points(self, given: Any, what: str) -> Float64:
        """Points (n, dim) of the optimizer, checked; what: it did, where they are none."""
        try:
            points = as_points(given, self.settings["dim"])
            if len(points) == 0:
                raise PointsError("there must be at least one")
        except PointsError as error:
            raise PointsError(f"{self.settings['optimizer']} {what}: {error}") from error
        return points

    def _result(self, verdict: Verdict) -> RunResult:
        return result_of(
            self.settings, self.record, verdict, budget=self._budget,
            status=self.optimizer.status, space=getattr(self.task, "space", None),
        )  # fmt: skip


def judge(
    reference: Callable[[Float64], Any] | None,
    target: Float32,
    loss: ImageLoss,
    x_best: Float64 | None,
    image: Float32 | None,
    x_recommended: Float64 | None = None,
    metrics: Mapping[str, ImageLoss] | None = None,
) -> Verdict:
    """Evaluate the best and, if given, the recommended candidate, by `TaskInfo.reference`.

    The lowest of many noisy losses is biased low.  metrics: other losses by name, for the best one.
    """
    if x_best is None or image is None:
        return Verdict()
    best = image if reference is None else as_target(reference(x_best))
    value, others = _loss(loss, best), {k: _loss(m, best) for k, m in (metrics or {}).items()}
    mse = _loss(losses_module.make("mse", target), best)
    if reference is None:
        return Verdict(best, value, mse, metrics=others)
    recommended = value
    if x_recommended is not None and not np.array_equal(x_recommended, x_best):
        recommended = _loss(loss, as_target(reference(x_recommended)))
    return Verdict(best, value, mse, x_recommended, recommended, others)


def _loss(loss: ImageLoss, image: Float32) -> float:
    return float(loss.compute(image[None])[0])
