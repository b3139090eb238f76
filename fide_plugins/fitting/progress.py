"""Progress of a fit in a terminal or notebook."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from fide_plugins.errors import OptionError
from fide_plugins.recording.record import Progress, Report

__all__ = ["check_progress", "reporting"]


def check_progress(progress: object) -> None:
    """Raise OptionError (a ValueError) unless it is True, False, None or a function."""
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise OptionError(f"progress must be True, False, None or a function, not {progress!r}")


@contextmanager
def reporting(progress: object) -> Iterator[Report | None]:
    """Context that gives a function which shows progress; None: nothing is to be shown.

    progress: None: a bar if standard error is a terminal; True: a bar; False: nothing; or a
        function of a `Progress`.

    Raises OptionError (a ValueError).
    """
    check_progress(progress)
    if progress is None:
        progress = sys.stderr is not None and sys.stderr.isatty()
    if callable(progress):
        yield progress
    elif progress:
        with _bar() as report:
            yield report
    else:
        yield None


@contextmanager
def _bar() -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeElapsedColumn

    columns = [  # without markup, since a remark may hold brackets
        BarColumn(bar_width=16),
        TextColumn("{task.completed}/{task.total}", markup=False),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    ]
    console = Console(stderr=True)
    with Bar(*columns, console=console, refresh_per_second=5, transient=True) as bar:
        line = bar.add_task("", total=None)

        def report(progress: Progress) -> None:
            words = progress.doing or progress.remark
            if not progress.doing and math.isfinite(progress.best_loss):
                words = f"best {progress.best_loss:.3g}  {words}"
            total = progress.budget or None
            bar.update(line, total=total, completed=progress.evaluations, description=words)

        yield report
