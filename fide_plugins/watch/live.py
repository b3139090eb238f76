"""What a fit says of itself between two checkpoints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fide_plugins.fitting.pictures import best_compared, picture
from fide_plugins.recording.directory import LIVE
from fide_plugins.recording.figures import as_png
from fide_plugins.recording.parameters import rows
from fide_plugins.runtime import files

if TYPE_CHECKING:
    from fide_plugins.fitting.callbacks import Event, Run

__all__ = ["LiveFile"]


class LiveFile:
    """Callback of `fit` that writes `live.json` and `best.png` into its run directory.

    every: seconds between two of them, at least.
    clock: seconds now, for tests.

    Without a run directory it does nothing.  A disk that is full does not end the fit.
    """

    def __init__(self, every: float = 0.5, clock: Callable[[], float] = time.monotonic) -> None:
        self._every, self._clock = every, clock
        self._out: Path | None = None
        self._workers, self._budget = 1, None
        self._written = -float("inf")
        self._new_best = True  # since best.png was written
        self._newest: Event | None = None

    def on_start(self, run: Run) -> None:
        """Remember the folder and the limits of `run`, which begins."""
        self._out, self._workers, self._budget = run.out, max(1, run.workers), run.budget  # type: ignore[assignment]

    def on_evaluation(self, event: Event) -> None:
        """Write what is known at an event, unless that was done just now."""
        self._new_best |= self._newest is None or event.best_loss != self._newest.best_loss
        self._newest, now = event, self._clock()
        if now >= self._written + self._every:
            self._written = now
            self._write(event, event.busy)

    def on_end(self, result: Any) -> None:
        """Write the end of it, and that no worker is busy; the result is not read."""
        if self._newest is not None:
            self._write(self._newest, 0)

    def _state(self, event: Event, busy: int) -> dict[str, Any]:
        best = event.optimizer.best
        table = [] if best is None else rows([replace(best, estimate=None)])  # which takes time
        return {
            "evaluations": event.evaluation + 1,
            "budget": self._budget,
            "seconds": event.seconds,
            "best_loss": event.best_loss,
            "parameters": [[row.name, row.values[0], row.unit] for row in table],
            "workers": self._workers,
            "busy": busy,
            "failures": event.failures,
            "sentence": str(event.optimizer.status),
        }

    def _write(self, event: Event, busy: int) -> None:
        if self._out is None:
            return
        with suppress(OSError):
            best = best_compared(event.optimizer) if self._new_best else None
            if best is not None:
                image = as_png(picture(event.optimizer, best))
                files.write_bytes(self._out / "best.png", image)
                self._new_best = False
            files.write_text(self._out / LIVE, json.dumps(self._state(event, busy)))
