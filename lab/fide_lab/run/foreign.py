"""Runs of tasks whose target the renderer did not draw: what is compared, and what judges.

Of two comparisons of the same pictures each has its own loss, so the task says how wrong a point is
(`TaskInfo.error`), which no optimizer sees.
"""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

from fide_lab.run.task import TaskInfo
from fide_plugins.comparison.coverage import without_coverage
from fide_plugins.recording.record import Record
from fide_plugins.types import Float32, Float64, Optimizer
from fide_plugins.validation.images import as_batch
from fide_plugins.validation.values import Clipping

ERROR = "error"
"""Name of the metric in the record of a run: the error of the best candidate so far."""


class Foreign:
    """Tells an optimizer renders of a task with an `error`.

    FIDE is told images and compares them itself.  Any other optimizer is told images and losses as
    ``photo=True`` would compare them, with the light set aside that the task says has changed.

    target: (H, W, 3).  loss: name.
    """

    def __init__(self, info: TaskInfo, target: Float32, loss: str, optimizer: Optimizer) -> None:
        from fide_plugins.fide import FIDE

        assert info.error is not None
        self.error, self._target, self._clipping = info.error, target, Clipping()
        self._fide = optimizer if isinstance(optimizer, FIDE) else None
        self._comparisons = 0 if self._fide is None else self._fide.state.comparisons
        if self._fide is None:
            from fide_plugins.evaluation import Evaluator
            from fide_plugins.options import Options

            light = None if info.light == "none" else info.light
            how = Options(photometric=light, robust="auto", background="free")
            self._evaluator = Evaluator(target, loss, "dense", options=how)

    def tell(
        self, optimizer: Optimizer, X: Float64, images: Any, record: Record
    ) -> tuple[Float32, Float64]:
        """Tell points (n, dim) with their renders; plain images (n, H, W, 3), and losses (n,)."""
        plain = as_batch(
            without_coverage(list(images)), self._target.shape, n=len(X), on_clip=self._clipping
        )
        if self._fide is not None:
            with record.timing(optimizer):
                return plain, self._fide.tell(X, list(images))
        assert self._evaluator.comparison is not None
        batch: Any = self._evaluator.as_batch(len(X), list(images), None, self._clipping)
        compared = self._evaluator.comparison.compare(batch)
        with record.timing(optimizer):
            optimizer.tell(X, np.clip(compared.images, 0, 1), compared.losses)
        return plain, compared.losses

    def note_errors(self, record: Record) -> None:
        """Enter the errors of the best candidates, and the best one of another comparison."""
        if self._fide is not None and self._fide.state.comparisons != self._comparisons:
            self._comparisons, best = self._fide.state.comparisons, self._fide.state.best
            if best is not None and best.solution.image is not None:
                found = best.solution
                record.best_loss, record.best_evaluation = found.loss, found.evaluation
                record.x_best, record.image = found.x.copy(), found.image
                record.improvements.append(record.evaluations - 1)
                record.path.append(found.x.copy())
        errors = record.metrics.setdefault(ERROR, array("d"))
        errors.extend(self.error(x) for x in record.path[len(errors) :])
