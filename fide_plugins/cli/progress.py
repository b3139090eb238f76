"""Progress of a run: lines on standard error."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator

from fide_plugins.cli.terminal import note, number
from fide_plugins.recording.record import PARTS, Progress, Report
from fide_plugins.runtime.messages import duration

_FIRST, _EVERY = 5.0, 60.0  # seconds until the first line, and between two: for a log file
_FEW = 8  # renders that an estimate of the time left needs


def interval(in_terminal: float) -> float:
    """Seconds between lines: `in_terminal` where somebody looks on, a minute elsewhere."""
    return in_terminal if sys.stderr.isatty() else _EVERY


def lines(what: str) -> Report:
    """Function that prints a line about the progress of `what`, every 5 seconds in a terminal.

    Elsewhere, as in a log, it is one after 5 seconds and then one a minute.
    """
    following = time.monotonic() + min(_FIRST, _EVERY)
    first: tuple[int, float] | None = None  # of this call, which may have resumed the run

    def report(progress: Progress) -> None:
        nonlocal following, first
        now = time.monotonic()
        first = first or (progress.evaluations, progress.wall_s)
        at_end = 0 < progress.budget <= progress.evaluations
        if now < following and not at_end:
            return
        following = now + interval(_FIRST)
        done = progress.evaluations - first[0]
        each = (progress.wall_s - first[1]) / max(done, 1)
        note("  ".join(filter(None, _parts(what, progress, each, done))))

    return report


def _parts(what: str, progress: Progress, each: float, done: int) -> Iterator[str]:
    """Parts of a line; each: seconds of a render, all workers together; done: in this call."""
    yield what
    yield f"{progress.evaluations}/{progress.budget}".removesuffix("/0")
    yield f"best {number(progress.best_loss)}" if math.isfinite(progress.best_loss) else ""
    yield f"{duration(each)} a render" if done else ""
    limits = [(progress.budget - progress.evaluations) * each] if progress.budget else []
    limits += [] if progress.time is None else [progress.time - progress.wall_s]
    left = min(limits, default=0.0) if done >= _FEW else 0.0
    yield f"about {duration(left)} left" if left > 0 else ""
    if progress.evaluations:
        total = max(progress.wall_s, 1e-9)
        yield "  ".join(f"{part} {progress.times[part] / total:.0%}" for part in PARTS)
    yield progress.remark
