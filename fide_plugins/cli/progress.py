"""Progress of a run on standard error: a bar in a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from fide_plugins.cli.messages import duration, note, number
from fide_plugins.experiments.run import Progress
from fide_plugins.recording.record import PARTS, Report

__all__ = ["lines", "reporting", "shares"]

_EVERY = 5.0  # seconds between lines


@contextmanager
def reporting(what: str) -> Iterator[Report]:
    """Context that gives a function which shows the progress of `what`."""
    if sys.stderr.isatty():
        with _bar(what) as report:
            yield report
    else:
        yield _Lines(what)


def lines(what: str) -> Report:
    """Function that prints a line about the progress of `what` every few seconds."""
    return _Lines(what)


def shares(progress: Progress) -> str:
    """Percentage of the time of each part."""
    total = max(progress.wall_s, 1e-9)
    return "  ".join(f"{part} {progress.times[part] / total:.0%}" for part in PARTS)


def _facts(progress: Progress, speed: float) -> str:
    """Best loss, where there is one, and renders per second, where something was rendered."""
    facts = [] if progress.doing else [f"best {number(progress.best_loss)}"]
    if speed > 0 or not progress.doing:
        facts.append(f"{speed:.0f} renders/s")
    return "  ".join(facts)


class _Speed:
    """Renders per second since the first call, which after resuming is not the start of the run.

    What is done before the search counts by itself.
    """

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._doing = ""

    def __call__(self, progress: Progress) -> float:
        if self._first is None or progress.doing != self._doing:
            self._first, self._doing = (progress.evaluations, progress.wall_s), progress.doing
        done, seconds = self._first
        return (progress.evaluations - done) / max(progress.wall_s - seconds, 1e-9)


class _Lines:
    def __init__(self, what: str) -> None:
        self._what, self._speed, self._last = what, _Speed(), time.monotonic()

    def __call__(self, progress: Progress) -> None:
        speed, now = self._speed(progress), time.monotonic()
        at_end = 0 < progress.budget <= progress.evaluations
        if now - self._last < _EVERY and not at_end:
            return
        self._last = now
        of = f"/{progress.budget}" if progress.budget else ""
        rest = progress.doing or shares(progress)
        rest += f"  {progress.remark}" if progress.remark else ""
        note(f"{self._what}  {progress.evaluations}{of}  {_facts(progress, speed)}  {rest}")


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

    speed = _Speed()
    columns = [  # without markup, since names may hold brackets
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=16),
        TextColumn("{task.completed}/{task.total}", markup=False),
        TextColumn("{task.fields[facts]}", markup=False),
    ]
    with TwoLines(*columns, console=Console(stderr=True), refresh_per_second=5) as bar:
        line = bar.add_task(what, total=1, facts="")

        def report(progress: Progress) -> None:
            rate = speed(progress)
            left = (progress.budget - progress.evaluations) / rate if rate > 0 else 0.0
            bar.below = progress.doing or shares(progress)
            if left > 0 and not progress.doing:
                bar.below += f"  {duration(left)} left"
            facts = _facts(progress, rate)
            bar.update(line, total=progress.budget, completed=progress.evaluations, facts=facts)

        yield report
