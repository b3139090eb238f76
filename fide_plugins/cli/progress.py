"""Progress of a run: a bar in a terminal, lines elsewhere, a page in the browser."""

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


@contextmanager
def reporting(what: str) -> Iterator[Report]:
    """Context that gives a function which shows the progress of `what`."""
    if sys.stderr.isatty():
        with _bar(what) as report:
            yield report
    else:
        yield _Lines(what)


def interval(in_terminal: float) -> float:
    """Seconds between lines: `in_terminal` where somebody looks on, a minute elsewhere."""
    return in_terminal if sys.stderr.isatty() else _EVERY


def lines(what: str) -> Report:
    """Function that prints a line about the progress of `what` once a minute."""
    return _Lines(what)


def shares(progress: Progress) -> str:
    """Percentage of the time of each part; empty before the first evaluation."""
    if not progress.evaluations:
        return ""
    total = max(progress.wall_s, 1e-9)
    return "  ".join(f"{part} {progress.times[part] / total:.0%}" for part in PARTS)


class _Pace:
    """Renders per second since the first call, which after resuming is not the start of the run."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._done, self._rate = 0, 0.0

    def note(self, progress: Progress) -> None:
        """Take the present state into account."""
        if self._first is None:
            self._first = progress.evaluations, progress.wall_s
        before, seconds = self._first
        self._done = progress.evaluations - before
        self._rate = self._done / max(progress.wall_s - seconds, 1e-9)

    def facts(self, progress: Progress) -> str:
        """Best loss and speed, as far as they are known.

        Below one render per second the speed is in seconds, all workers together.
        """
        facts = []
        if math.isfinite(progress.best_loss):
            facts.append(f"best {number(progress.best_loss)}")
        if self._rate >= 1:
            digits = 1 if self._rate < 9.95 else 0
            facts.append(f"{self._rate:.{digits}f} renders/s")
        elif self._rate > 0:
            facts.append(f"{1 / self._rate:.1f} s a render")
        return "  ".join(facts)

    def left(self, progress: Progress) -> str:
        """Time until the budget or the time limit ends the run; empty where it is not known."""
        limits = []
        if progress.budget:
            limits.append((progress.budget - progress.evaluations) / max(self._rate, 1e-9))
        if progress.time is not None:
            limits.append(progress.time - progress.wall_s)
        if self._done < _FEW or not limits or min(limits) <= 0:
            return ""
        return f"about {_rounded(min(limits))} left"


def _rounded(seconds: float) -> str:
    """A duration in one unit.

    >>> _rounded(40.2), _rounded(1500), _rounded(14000)
    ('40 s', '25 min', '4 h')
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.0f} h"


def _joined(*parts: str) -> str:
    return "  ".join(filter(None, parts))


class _Lines:
    def __init__(self, what: str) -> None:
        self._what, self._pace = what, _Pace()
        self._next = time.monotonic() + min(_FIRST, _EVERY)

    def __call__(self, progress: Progress) -> None:
        pace, now = self._pace, time.monotonic()
        pace.note(progress)
        at_end = 0 < progress.budget <= progress.evaluations
        if now < self._next and not at_end:
            return
        self._next = now + _EVERY
        done = f"{progress.evaluations}/{progress.budget}".removesuffix("/0")
        facts = pace.facts(progress), pace.left(progress)
        note(_joined(self._what, done, *facts, shares(progress), progress.remark))


@contextmanager
def _bar(what: str) -> Iterator[Report]:
    from rich.console import Console, RenderableType
    from rich.progress import BarColumn, Progress as Bar, TextColumn
    from rich.text import Text

    class TwoLines(Bar):
        """A bar and, below it, the time split, so that both fit a narrow terminal."""

        below = ""

        def get_renderables(self) -> Iterator[RenderableType]:
            yield from super().get_renderables()
            yield Text(self.below, style="dim", overflow="ellipsis", no_wrap=True)

    pace = _Pace()
    columns = [  # without markup, since names may hold brackets
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=16),
        TextColumn("{task.completed}/{task.total}", markup=False),
        TextColumn("{task.fields[facts]}", markup=False),
    ]
    with TwoLines(*columns, console=Console(stderr=True), refresh_per_second=5) as bar:
        line = bar.add_task(what, total=1, facts="")

        def report(progress: Progress) -> None:
            pace.note(progress)
            bar.below = _joined(shares(progress), pace.left(progress))
            facts = pace.facts(progress)
            bar.update(line, total=progress.budget, completed=progress.evaluations, facts=facts)

        yield report


# -- the page of a run, in the browser while the command goes on -----------------------------------


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
