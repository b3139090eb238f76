"""A callback that writes for TensorBoard: scalars, the best image, the result.

    from fide_plugins.fitting.callbacks.tensorboard import TensorBoard
    fit(..., callbacks=[TensorBoard("runs/first/tensorboard")])

``tensorboard --logdir runs/first/tensorboard`` shows it in a browser.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.fitting.callbacks import Event, Run
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32

if TYPE_CHECKING:
    from fide_plugins.fitting.result import Result

__all__ = ["TensorBoard"]


class TensorBoard:
    """Writes event files into a folder; a step is an evaluation, from 1.

    logdir: folder, made if it is missing.
    every: evaluations between two points of the curves.

    Scalars: loss, best loss, renders under way, failures, and every number among the best
    parameters.  Images: target and best.  Text: the result.

    Raises DependencyError (an ImportError) if the package `tensorboard` is not installed.
    """

    def __init__(self, logdir: str | os.PathLike[str], every: int = 1) -> None:
        try:
            writer = import_module("torch.utils.tensorboard").SummaryWriter
        except ImportError as error:
            what = "TensorBoard's event files need the package tensorboard"
            raise missing("tensorboard", what) from error
        self._make: Callable[[], Any] = lambda: writer(os.fspath(logdir))
        self._every = max(1, every)
        self._writer: Any = None

    def on_start(self, run: Run) -> None:
        """Open the files, and write the target."""
        self._writer = self._make()
        self._add_images("target", run.optimizer.views.targets, run.evaluations)

    def on_evaluation(self, event: Event) -> None:
        """Write scalars."""
        step = event.evaluation + 1
        if step % self._every:
            return
        values = {
            "loss/each": event.loss,
            "loss/best": event.best_loss,
            "workers/busy": event.busy,
            "workers/failures": event.failures,
        }
        for name, value in values.items():
            if np.isfinite(value):
                self._writer.add_scalar(name, value, step)

    def on_improvement(self, event: Event) -> None:
        """Write the best image and its parameters."""
        step = event.evaluation + 1
        views, best = event.optimizer.views, event.optimizer.state.best
        if best is not None and best.solution.image is not None:  # in [0, 1]
            self._add_images("best", views.unpacked(best.solution.image), step)
        space = event.optimizer.space
        if space is not None:
            numbers = space.layout.numbers(event.x[None])[0].tolist()
            for name, number in zip(space.names, numbers, strict=True):
                self._writer.add_scalar(f"parameters/{name}", number, step)

    def on_end(self, result: Result) -> None:
        """Write the result, and close the files."""
        if self._writer is not None:
            self._writer.add_text("result", f"```\n{result!r}\n```", result.evaluations)
            self._writer.close()
            self._writer = None

    def _add_images(self, name: str, images: Float32 | list[Float32], step: int) -> None:
        several = images if isinstance(images, list) else [images]
        for i, image in enumerate(several):
            view = f"{name}/{i}" if len(several) > 1 else name
            self._writer.add_image(view, image, step, dataformats="HWC")
