"""The run loop: ask, render, evaluate, tell, until the budget is spent.

The loop asks for a whole generation, and renders it in pieces of a fixed size, so that results
arrive and can be saved before a slow generation is complete.  A user's renderer makes one image
after the other, so each is told at once: an interrupt or a failure loses no other.  The size is
fixed because the same seed must give the same run: a size that depends on the renderer's speed
would change the last bits of features that are computed in batches.  An optimizer that trains in
the background first gives the candidates that need not wait for the training (`FIDE.ask_ready`).
FIDE's steps between two generations come one at a time.

Resuming gives the result of an uninterrupted run, bit for bit.  The state is saved only between
pieces, together with the pending candidates, and each evaluation of a noisy renderer has its own
seed.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fide_lab.run.pixel_samples import Fidelity
from fide_lab.run.task import Task, TaskInfo
from fide_plugins import losses as losses_module
from fide_plugins.errors import FideError, PointsError, RenderError
from fide_plugins.learning.hypotheses import Rounds
from fide_plugins.losses.base import ImageLoss
from fide_plugins.recording.directory import CheckpointTimer, RunDirectory, note_unsaved
from fide_plugins.recording.record import (
    Keep,
    Progress,
    Record,
    Report,
    RunResult,
    Verdict,
    result_of,
)
from fide_plugins.recording.signals import Interrupted, Interrupts
from fide_plugins.types import Float32, Float64, Optimizer
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.pixels import Clipping
from fide_plugins.validation.points import as_points


def judge(
    reference: Callable[[Float64], Any] | None,
    target: Float32,
    loss: ImageLoss,
    x_best: Float64 | None,
    image: Float32 | None,
    x_recommended: Float64 | None = None,
    metrics: Mapping[str, ImageLoss] | None = None,
) -> Verdict:
    """Evaluate the best candidate and, if given, the recommended candidate.

    reference: of the task, see `TaskInfo`.
    metrics: other losses by name, for the best one.
    """
    start = time.perf_counter()
    if x_best is None or image is None:
        return Verdict()
    best = image if reference is None else as_target(reference(x_best))
    value, others = _loss(loss, best), {k: _loss(m, best) for k, m in (metrics or {}).items()}
    if reference is None:
        return Verdict(best, value, _mse(target, best), metrics=others)
    recommended = value
    if x_recommended is not None and not np.array_equal(x_recommended, x_best):
        recommended = _loss(loss, as_target(reference(x_recommended)))
    seconds = time.perf_counter() - start
    return Verdict(best, value, _mse(target, best), x_recommended, recommended, others, seconds)


def _loss(loss: ImageLoss, image: Float32) -> float:
    return float(loss.compute(image[None])[0])


def _mse(target: Float32, image: Float32) -> float:
    return float(losses_module.make("mse", target)(image[None])[0])


def marks(budget: int) -> list[int]:
    """Numbers of renders after which a frame is kept; the last one is `budget`.

    >>> marks(500)
    [1, 3, 10, 30, 100, 300, 500]
    """
    decades = (factor * 10**power for power in range(len(str(budget))) for factor in (1, 3))
    return [mark for mark in decades if mark < budget] + [budget]


def frames(
    first: int, before: Float32 | None, batch: Float32, improved: Sequence[int], budget: int
) -> Iterator[tuple[int, Float32]]:
    """Marks that a piece of candidates passes, each with the best image (H, W, 3) by then.

    first: renders before the piece; before: best image before the piece, or None.
    batch: images of the piece, (n, H, W, 3); improved: indices of images that were the best so far.
    """
    for mark in marks(budget):
        if first < mark <= first + len(batch):
            better = [i for i in improved if first + i < mark]
            image = batch[better[-1]] if better else before
            if image is not None:
                yield mark, image


PIECE = 32
"""Largest number of candidates that are rendered before their results are told, where the task does
not say another; see `TaskInfo.piece`."""


class Run:
    """A run that is ready to start or to continue; made by `prepare`, which checks everything.

    task, target: scene, and the picture to find (H, W, 3).
    optimizer, loss: what asks for candidates, and what judges their images.
    settings: what defines the run, as `run.json` records it.
    record: history so far.
    directory: run directory, or None.
    checkpoint_every: seconds between checkpoints, see `CheckpointTimer`.
    keep, metrics: what to record beside the loss, and the losses that this needs, by name.
    fidelity: numbers of samples per pixel that rise; None where they stay.
    rounds: of learning before the search, for an optimizer that begins with a model; None: none.
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
        fidelity: Fidelity | None = None,
        rounds: Rounds | None = None,
    ) -> None:
        self.task, self.target, self.optimizer, self.loss = task, target, optimizer, loss
        self.settings, self.record = settings, record
        self._directory, self._checkpoint_every = directory, checkpoint_every
        self._keep, self._metrics, self._fidelity = keep, metrics, fidelity
        self._rounds = rounds
        self._budget: int = settings["budget"]
        self._piece = TaskInfo.of(task).piece or PIECE
        self._clipping = Clipping()
        self._whole = True  # whether record and optimizer agree, so that they may be saved

    @property
    def advice(self) -> str | None:
        """What the task advises for this loss; None for nothing."""
        advice = TaskInfo.of(self.task).advice
        return None if advice is None else advice(self.loss.name)

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
        self._clock = time.perf_counter()
        self._checkpoints = CheckpointTimer(self._checkpoint_every)
        held = nullcontext() if self._directory is None else closing(self._directory)
        with held, Interrupts(once=True) as interrupts:
            try:
                if on_progress is not None:
                    on_progress(self.progress)
                if self._rounds is not None:
                    if not self.record.evaluations:
                        self._learn(self._rounds, interrupts, on_progress)
                    self._rounds.remove_renders()  # also where a call was killed before that
                while self.record.evaluations < self._budget:
                    self._step(interrupts)
                    if on_progress is not None:
                        on_progress(self.progress)
                    self._save_if_due()
                    interrupts.check()
                self._save()
                with interrupts.stoppable():
                    verdict = self._judge()
            except Interrupted:
                self._leave("interrupted")
                raise
            except BaseException as error:
                interrupts.hold()
                try:
                    self._leave("failed")
                except Exception as unsaved:  # of the disk, or of a user's optimizer
                    note_unsaved(error, unsaved)
                raise
            interrupts.hold()
            return self._finish(verdict)

    def _learn(self, rounds: Rounds, interrupts: Interrupts, on_progress: Report | None) -> None:
        """Learn before the search, which then begins with the model."""

        def show(renders: int, doing: str) -> None:
            self._tick()
            if on_progress is not None:
                on_progress(replace(self.progress, evaluations=renders, doing=doing))

        with interrupts.stoppable():
            learned = rounds.learn(1, show)
        optimizer: Any = self.optimizer  # FIDE itself
        optimizer.begin_with(learned.model, learned.renders)
        self._tick()
        self.record.add_unjudged(learned.renders)
        self._save()

    # -- one piece ---------------------------------------------------------------------------------

    def _step(self, interrupts: Interrupts) -> None:
        """Render, evaluate and tell one piece; ask for a generation if none is pending."""
        record = self.record
        if record.pending is None or len(record.pending) == 0:
            X = self._checked(self._of_optimizer(self.optimizer.ask_ready))
            record.pending = X
            record.generations.append(len(X))
            self._whole = True
            if self._checkpoints.every > 0:  # the optimizer has just waited for its training
                self._save_if_due()
        n = min(self._piece, self._budget - record.evaluations)  # a larger budget takes the rest
        X, rest = record.pending[:n], record.pending[n:]
        with interrupts.stoppable():
            start = time.perf_counter()
            images, extra = self._render(X), self._render_extra(X)
            rendered = time.perf_counter()
        batch = as_batch(images, self.target.shape, n=len(X), on_clip=self._clipping)
        losses = self.loss.compute(batch)
        others = self.loss.compute(extra) if len(extra) else np.empty(0)
        record.times["render"] += rendered - start
        record.times["encode"] += time.perf_counter() - rendered
        self._of_optimizer(lambda: self.optimizer.tell(X, batch, losses))
        self._tick()
        if self._fidelity is not None:
            self._fidelity.note(record, losses, extra, others, more=len(rest) > 0)
            record.fidelity = self._fidelity.state_dict()
        first, before = record.evaluations, record.image
        improved = record.add(X, batch, losses)
        self._observe(first, before, batch, improved)
        record.pending = rest
        self._whole = True

    def _observe(
        self, first: int, before: Float32 | None, batch: Float32, improved: list[int]
    ) -> None:
        """Measure improvements by the other losses, and film them; does not count as run time.

        first: evaluations before this piece; before: best image before this piece; improved:
        indices of the candidates of the piece that improved the best loss.
        """
        start = time.perf_counter()
        for name, metric in self._metrics.items():
            values = self.record.metrics.setdefault(name, array("d"))
            if improved:
                values.extend(metric.compute(batch[improved]).tolist())
        if self._keep.film and self._directory is not None:
            for mark, image in frames(first, before, batch, improved, self._budget):
                self._directory.write_frame(mark, image)
        self._clock = time.perf_counter()
        self.record.watch_s += self._clock - start

    def _checked(self, X: Any) -> Float64:
        """Candidates (n, dim) of the optimizer; PointsError if they break the protocol."""
        try:
            points = as_points(X, self.settings["dim"])
            if len(points) == 0:
                raise PointsError("there must be at least one")
        except PointsError as error:
            raise PointsError(
                f"{self.settings['optimizer']} asked for impossible candidates: {error}"
            ) from error
        return points

    def _render_extra(self, X: Float64) -> Float32:
        """Images (m, H, W, 3) of the extra points that `Fidelity` needs, usually none."""
        points = X[:0] if self._fidelity is None else self._fidelity.extra_points(X, self.record)
        if not len(points):
            return np.empty((0, *self.target.shape), np.float32)
        images = self._render(points, 2**39)
        return as_batch(images, self.target.shape, n=len(points), on_clip=self._clipping)

    def _render(self, X: Float64, stream: int = 0) -> Any:
        first = self.settings["seed"] * 2**40 + stream + self.record.evaluations
        render = self.task.render if self._fidelity is None else self._fidelity.render
        try:
            return render(X, seed=[first + i for i in range(len(X))])
        except FideError:
            raise
        except Exception as error:
            raise RenderError(
                f"{self.settings['task']} failed to render candidates "
                f"{self.record.evaluations} to {self.record.evaluations + len(X) - 1}: {error!r}"
            ) from error

    def _of_optimizer(self, step: Callable[[], Any]) -> Any:
        """Result of a step of the optimizer, timed.

        Until the caller records the result, the state is not consistent and must not be saved.
        """
        self._whole = False
        with self.record.timing(self.optimizer):
            return step()

    def _tick(self) -> None:
        now = time.perf_counter()
        self.record.wall_s += now - self._clock
        self._clock = now

    # -- saving and leaving ------------------------------------------------------------------------

    def _save_if_due(self) -> None:
        if self._checkpoints.due(self.optimizer):
            self._save()

    def _save(self) -> None:
        self._tick()  # the optimizer's last step may be in `times` alone
        with self._checkpoints.writing():
            if self._directory is not None:
                self._directory.save(self.record, self.optimizer)
                self._write_tables(self._directory)
        self._tick()

    def _write_tables(self, directory: RunDirectory) -> None:
        directory.write_tables(self.record, self.record.image)
        directory.write_target(self.target)

    def _leave(self, state: str) -> None:
        """Save a consistent state, or all but that, before an exception is raised on."""
        if self._directory is None:
            return
        if self._whole:
            self._save()
        else:
            with suppress(Exception):  # of a record that is not whole; the totals matter more
                self._write_tables(self._directory)
        r = self.record
        found = self.target, self.loss, r.x_best, r.image
        try:
            seen = judge(None, *found, metrics=self._metrics)
        except Exception:  # of the metric that has ended the run
            seen = judge(None, *found)
        result = self._result(seen)
        self._directory.write_run(state, result)
        if state == "interrupted" and self._keep.summary and self.record.evaluations:
            self._directory.write_summary(result, self.target)

    def _finish(self, verdict: Verdict) -> RunResult:
        """Write all results."""
        result = self._result(verdict)
        if self._directory is not None:
            self._directory.write_reference(result)
            if self._keep.summary:
                self._directory.write_summary(result, self.target)
            self._directory.write_run("finished", result)
            if not self._keep.checkpoint:
                self._directory.remove_checkpoint()
        return result

    def _judge(self) -> Verdict:
        """Evaluate the best and the recommended candidate; does not count as run time."""
        r = self.record
        recommended = None if r.x_best is None else self._recommended()
        try:
            reference = TaskInfo.of(self.task).reference
            return judge(
                reference, self.target, self.loss, r.x_best, r.image, recommended, self._metrics
            )
        except FideError:
            raise
        except Exception as error:
            raise RenderError(
                f"{self.settings['task']} failed to judge the result: {error!r}"
            ) from error
        finally:
            self._clock = time.perf_counter()

    def _recommended(self) -> Float64:
        """Recommendation of the optimizer, (dim,); PointsError if it lies outside the box."""
        point = self.optimizer.recommend()
        try:
            (checked,) = as_points(np.asarray(point)[None], self.settings["dim"])
        except PointsError as error:
            raise PointsError(
                f"{self.settings['optimizer']} recommended an impossible point: {error}"
            ) from error
        return np.asarray(checked)

    def _result(self, verdict: Verdict) -> RunResult:
        return result_of(
            self.settings,
            self.record,
            verdict,
            budget=self._budget,
            samples=None if self._fidelity is None else self._fidelity.total,
            status=self.optimizer.status,
            space=getattr(self.task, "space", None),
        )
