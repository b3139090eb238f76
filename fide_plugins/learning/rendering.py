"""Fills a store of renders, in this process or in several; counts what fails."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from multiprocessing import current_process

import numpy as np

from fide_plugins.errors import FideError, OptionError, RenderError
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered, Task, Workers
from fide_plugins.fitting.workers import DAEMON, InThisProcess
from fide_plugins.learning.renders import SHARD, BatchRenderer, Pixels, RenderStore, Small
from fide_plugins.types import Float64

_FEW = 500  # renders that say that a renderer must be mended
_MOST_LOST = 10  # single renders in a row that end their worker


def all_equal(name: str, renders: int) -> RenderError:
    """Error of a renderer of that name whose images say nothing of its parameters."""
    return RenderError(
        f"the images of {name} for {renders} random parameters are all equal, in 8 bits and at the "
        "size that is learned: mend it, change the ranges of its parameters (what they change may "
        "be out of view), or give a larger size"
    )


def too_few(there: int, least: int, failed: int, renders: int) -> FideError:
    """Error that names what is missing: renders that succeed, renders at all, or time."""
    few = f"{there} renders are too few to learn from (at least {least})"
    if failed == 0:
        return OptionError(f"{few}; allow more time")
    return RenderError(
        f"{few}: {failed} of {there + failed} failed; mend the renderer, make the ranges of its "
        f"parameters smaller, or ask for more than {renders} renders"
    )


@dataclass(frozen=True)
class _Shards:
    """Renders points (n, d) of the cube, with the noise seed of each, in a worker."""

    renderer: BatchRenderer
    size: tuple[int, int]

    def __call__(self, points: tuple[Float64, list[int]]) -> Outcome:
        start = time.perf_counter()
        images = self.renderer.small(*points, self.size)
        return Rendered(images, time.perf_counter() - start)


def pool_for(renderer: BatchRenderer, size: tuple[int, int], workers: int) -> Workers:
    """Where renders of this size (height, width) are made; workers: 0 and 1: this process.

    Raises OptionError for a renderer that cannot be sent there, and in a daemonic process.
    """
    shards = _Shards(renderer, size)
    if workers <= 1:
        return InThisProcess(shards)
    if current_process().daemon:
        raise OptionError(f"{DAEMON}; give workers=0")
    try:
        return Processes(shards, workers)
    except Exception as error:  # whatever the user's objects raise when they are pickled
        raise OptionError(
            f"{renderer.name} cannot be sent to other processes ({error}): make what it needs "
            "inside of it, or take workers=1"
        ) from error


def fill(
    store: RenderStore,
    renderer: BatchRenderer,
    renders: int,
    *,
    workers: int = 1,
    seconds: float | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Render what is missing of `renders`; no shard is begun after so many seconds.

    on_progress: called with the number of renders done so far.
    Raises RenderError if workers die again and again, or if the first 500 renders of this call, or
    more, mostly fail or are all equal.  What was rendered before stays, but for shards that such a
    renderer has spoiled: the next call renders them again.
    """
    missing = store.missing(renders)
    stop = np.inf if seconds is None else time.monotonic() + seconds
    failed: dict[int, int] = {}  # of each shard
    why, equal, first = "", True, np.empty(0, np.uint8)
    pool = pool_for(renderer, store.shape[:2], workers)
    try:
        for shard, images in _rendered(store, renderer.name, missing, stop, pool):
            store.write(shard, images)
            there: list[Pixels] = [one for one in images if not isinstance(one, Failed)]
            failed[shard] = SHARD - len(there)
            why = why or next((one.reason for one in images if isinstance(one, Failed)), "")
            first = there[0] if there and not first.size else first
            equal = equal and all(np.array_equal(image, first) for image in there)
            tried, lost = SHARD * len(failed), sum(failed.values())
            if tried >= _FEW and (equal or 2 * lost > tried):
                store.remove([one for one, some in failed.items() if some or equal])
                if 2 * lost <= tried:
                    raise all_equal(renderer.name, tried - lost)
                raise RenderError(
                    f"{renderer.name} failed for {lost} of {tried} random parameters, or gave no "
                    "image: mend it, or make the ranges of its parameters smaller; the first one: "
                    f"{why}"
                )
            on_progress(min(max(renders + SHARD * (len(failed) - len(missing)), 0), renders))
    finally:
        pool.close()


def _rendered(
    store: RenderStore, name: str, missing: Sequence[int], stop: float, pool: Workers
) -> Iterator[tuple[int, list[Small]]]:
    """Shards with their images; one whose worker dies is rendered again, one by one."""
    waiting = deque((shard, list(range(SHARD))) for shard in missing)
    running: dict[Task, tuple[int, list[int]]] = {}
    found: dict[int, dict[int, Small]] = {}
    lost = 0
    while waiting or running:
        while waiting and len(running) < pool.number:
            shard, rows = waiting.popleft()
            if shard not in found and time.monotonic() > stop:
                continue
            found.setdefault(shard, {})
            seeds = store.noise_seeds(shard)
            points = store.parameters(shard)[rows], [seeds[row] for row in rows]
            running[pool.submit(points)] = shard, rows
        for task in wait(running, return_when=FIRST_COMPLETED).done:
            shard, rows = running.pop(task)
            outcome = pool.outcome(task)
            if isinstance(outcome, Rendered):
                lost = 0
                found[shard].update(zip(rows, outcome.image, strict=True))
            elif len(rows) > 1:
                waiting.extendleft((shard, [row]) for row in reversed(rows))
            else:
                lost += 1
                found[shard][rows[0]] = outcome
                if lost == _MOST_LOST:
                    raise RenderError(
                        f"{name} failed in its worker {lost} times in a row, perhaps for lack of "
                        f"memory; try fewer workers; the last time: {outcome.reason}"
                    )
            if len(found[shard]) == SHARD:
                images = found.pop(shard)
                yield shard, [images[row] for row in range(SHARD)]
