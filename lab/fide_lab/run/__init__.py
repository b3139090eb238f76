"""One run: ask, render, evaluate, tell, for every optimizer; timed, recorded, resumable.

    >>> from fide_lab import run as harness
    >>> result = harness.run("voronoi", "cma", budget=30, size=32, seed=0)
    >>> result.evaluations
    30
    >>> result.best_loss == result.losses.min().item()
    True

`prepare`      makes a `Run` from names and options, all checked
`task`         what is fitted: the protocol of a task, a user's renderer as a task
`loop`         generations, rendered in pieces; the loop is that of `fit`
`kept_target`  the target to the last bit, in a file
`foreign`      tasks whose target the renderer did not draw
=============  ==================================================================
=======
Errors of `prepare`, which makes a `Run`, are usage errors; errors of its `execute` are failed runs.
"""

from __future__ import annotations

from fide_lab.run.loop import Keep, Run
from fide_lab.run.prepare import prepare, run
from fide_plugins.recording.record import Progress, RunResult
from fide_plugins.recording.signals import Interrupted

__all__ = ["Interrupted", "Keep", "Progress", "Run", "RunResult", "prepare", "run"]
