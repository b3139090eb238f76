"""One run: ask, render, evaluate, tell, for every optimizer; timed, recorded, resumable.

    >>> from fide_lab import run as harness
    >>> result = harness.run("voronoi", "cma", budget=30, size=32, seed=0)
    >>> result.evaluations
    30
    >>> result.best_loss == result.losses.min().item()
    True

Errors of `prepare`, which makes a `Run`, are usage errors; errors of its `execute` are failed runs.
"""

from __future__ import annotations

from fide_lab.run.loop import Keep, Run
from fide_lab.run.prepare import prepare, run
from fide_lab.run.result import RunResult
from fide_plugins.recording.record import Progress
from fide_plugins.recording.signals import Interrupted

__all__ = ["Interrupted", "Keep", "Progress", "Run", "RunResult", "prepare", "run"]
