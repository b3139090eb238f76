"""Progress of a run: lines on standard error, and a page in the browser."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fide_plugins.cli.terminal import note, number, plain
from fide_plugins.recording.record import PARTS, Progress, Report

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
        here = progress.evaluations - first[0]
        rate = here / max(progress.wall_s - first[1], 1e-9)
        best = f"best {number(progress.best_loss)}" if math.isfinite(progress.best_loss) else ""
        done = f"{progress.evaluations}/{progress.budget}".removesuffix("/0")
        left = _left(progress, rate) if here >= _FEW else ""
        parts = what, done, best, _speed(rate), left, _shares(progress), progress.remark
        note("  ".join(filter(None, parts)))

    return report


def _shares(progress: Progress) -> str:
    """Percentage of the time of each part; empty before the first evaluation."""
    if not progress.evaluations:
        return ""
    total = max(progress.wall_s, 1e-9)
    return "  ".join(f"{part} {progress.times[part] / total:.0%}" for part in PARTS)


def _speed(rate: float) -> str:
    """Renders per second, all workers together; below one, the seconds of a render."""
    if rate >= 1:
        return f"{rate:.{1 if rate < 9.95 else 0}f} renders/s"
    return f"{1 / rate:.1f} s a render" if rate > 0 else ""


def _left(progress: Progress, rate: float) -> str:
    """Time until the budget or the time limit ends the run; empty where it is not known."""
    limits = []
    if progress.budget:
        limits.append((progress.budget - progress.evaluations) / max(rate, 1e-9))
    if progress.time is not None:
        limits.append(progress.time - progress.wall_s)
    seconds = min(limits, default=0.0)
    for size, unit, most in ((1, "s", 90), (60, "min", 90 * 60), (3600, "h", math.inf)):
        if 0 < seconds < most:
            return f"about {max(1, round(seconds / size))} {unit} left"
    return ""


@contextmanager
def page_of(out: Path) -> Iterator[None]:
    """Within this block, the page of a run directory is served and open in the browser."""
    from fide_plugins.watch import serve

    server, url = serve(out)
    try:
        note(f"{url} shows {plain(out)} until the command ends")
        open_page(url)
        yield
    finally:
        server.close()


def open_page(url: str) -> None:
    """Open the browser, without waiting: some return when their window is closed."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
