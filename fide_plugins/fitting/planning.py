"""How a fit spends its time: what a render takes, by size, and what follows; in three lines."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any

from fide_plugins.fitting.rendering import Rendered, Workers
from fide_plugins.fitting.schedule import SHARE, Schedule
from fide_plugins.fitting.workers import gathered
from fide_plugins.runtime.messages import duration

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_CHEAPER = 0.7  # of the time of the next size: a smaller one that takes more is left out
_OWN = 0.001  # seconds that the optimizer takes for a candidate
_TO_LEARN = 100_000  # renders


class Planner:
    """Measures renders and makes the plan of a fit of so many seconds.

    lines: of the plan, three; none before it is made.
    """

    def __init__(self, seconds: float, number: int) -> None:
        self.lines: list[str] = []
        self._seconds, self._workers = seconds, max(1, number)

    def measure(
        self, optimizer: FIDE, schedule: Schedule, workers: Workers, timeout: float | None
    ) -> None:
        """Render where the search begins at each size, and leave out those that save no time.

        workers: without a schedule.  Each render counts as cost; where one fails nothing is known.
        """
        x = optimizer.state.search.mean
        asked = [0, *range(len(schedule.sizes))]  # the first loads what the renderer needs
        took: dict[int, float] = {}
        for k in asked:
            point: Any = [(x, schedule.keywords(k, schedule.samples, seed=k))]
            for outcome in gathered(workers, point, timeout):
                schedule.pay(k, schedule.samples)
                if isinstance(outcome, Rendered):
                    took[k] = outcome.seconds
        if len(took) < len(schedule.sizes):
            return
        kept = [len(schedule.sizes) - 1]
        for k in reversed(range(len(schedule.sizes) - 1)):
            if took[k] <= _CHEAPER * took[kept[0]]:
                kept.insert(0, k)
        sizes = [_pixels(schedule.sizes[k]) + f" ({duration(took[k])})" for k in kept]
        out = [_pixels(schedule.sizes[k]) for k in took if k not in kept]
        first = f"pictures of {', '.join(sizes)} pixels"
        if out:
            first += f"; not {', '.join(out)}, which save no time"
        schedule.keep(kept)
        self._make(first, took[kept[0]], took[kept[-1]])

    def show(self, wanted: bool) -> None:
        """Print the plan to standard error, where that is wanted."""
        if wanted and sys.stderr is not None:
            lines = [f"plan: {line}\n" for line in self.lines]
            print(
                "\r\x1b[K" if sys.stderr.isatty() else "", *lines, sep="", end="", file=sys.stderr
            )

    def _make(self, first: str, least: float, most: float) -> None:
        coarse, fine = (self._workers / (one + _OWN * self._workers) for one in (least, most))
        share = SHARE if least < most else 0.0
        renders = self._seconds * (share * coarse + (1 - share) * fine)
        second = (
            f"about {renders:,.0f} renders in {duration(self._seconds)}, {self._workers} at a time"
        )
        if share:
            second += f"; of full size after {duration(share * self._seconds)} at the latest"
        learning = _TO_LEARN * least / self._workers
        pictures = math.ceil(learning / self._seconds) + 1
        third = f"to learn the renderer first takes about {duration(learning)}: for {pictures}"
        self.lines = [first, second, f"{third} pictures of it or more"]


def _pixels(size: Any) -> str:
    """Width and height; of views of several sizes, of each."""
    several = [size] if isinstance(size, tuple) else size
    return ", ".join(f"{width} x {height}" for height, width in several)
