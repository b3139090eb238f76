"""Fills a store of renders, in this process or in several."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass, field

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered
from fide_plugins.fitting.workers.base import Task
from fide_plugins.fitting.workers.processes import Processes
from fide_plugins.learning.renderer import Renderer, Small
from fide_plugins.learning.store import SHARD, RenderStore
from fide_plugins.types import Float64

__all__ = ["check_picklable", "fill"]

_FEW = 500  # renders before a renderer can be given up
_MOST_LOST = 10  # single renders that end their worker, without another one in between


def fill(
    store: RenderStore,
    renderer: Renderer,
    renders: int,
    *,
    workers: int = 1,
    seconds: float | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> int:
    """Render what is missing of `renders`; returns how many renders failed in this call.

    workers: processes; with more than one the renderer must be picklable, and a render that ends
        its process (for lack of memory, say) is one that failed.
    seconds: no shard is begun after this time; None: no limit.
    on_progress: called with the number of renders done so far.

    Raises RenderError if most renders fail, or workers die again and again; OptionError if the
    renderer cannot be sent to workers.  What was rendered before an error stays, but for shards of
    this call in which renders have failed: they are rendered again by the next call.
    """
    missing = store.missing(renders)
    done, tried = renders - SHARD * len(missing), 0
    failed: dict[int, int] = {}  # of each shard of this call
    first = ""
    stop = None if seconds is None else time.monotonic() + seconds
    shards = _in_workers if workers > 1 else _here
    try:
        for shard, images in shards(store, renderer, missing, stop, workers):
            failed[shard] = store.write(shard, images)
            first = first or next((image for image in images if isinstance(image, str)), "")
            tried, done = tried + SHARD, done + SHARD
            if tried >= _FEW and 2 * sum(failed.values()) > tried:
                raise RenderError(given_up(renderer.name, sum(failed.values()), tried, first))
            if on_progress is not None:
                on_progress(min(max(done, 0), renders))
    except RenderError:
        store.remove([shard for shard, number in failed.items() if number])
        raise
    return sum(failed.values())


def given_up(name: str, failed: int, tried: int, why: str) -> str:
    """Message of a renderer of that name that fails mostly; why: the first one failed."""
    return (
        f"{name} failed for {failed} of {tried} random parameters, or gave no image: mend it, or "
        f"make the ranges of its parameters smaller; the first one: {why}"
    )


def _here(
    store: RenderStore, renderer: Renderer, missing: Sequence[int], stop: float | None, workers: int
) -> Iterator[tuple[int, list[Small]]]:
    for shard in missing:
        if stop is not None and time.monotonic() > stop:
            return
        seeds = store.noise_seeds(shard)
        yield shard, renderer.small(store.parameters(shard), seeds, store.size)


def _in_workers(
    store: RenderStore, renderer: Renderer, missing: Sequence[int], stop: float | None, workers: int
) -> Iterator[tuple[int, list[Small]]]:
    """As `_here`, in processes.

    A shard whose worker dies is rendered again, one by one, to know which render it was.
    """
    pool = _pool(renderer, store.size, workers)
    waiting, running = deque(missing), dict[Task, _Job]()
    lost = 0
    try:
        while True:
            late = stop is not None and time.monotonic() > stop
            while waiting and len(running) < workers and not late:
                shard = waiting.popleft()
                job = _Job(shard, store.parameters(shard), store.noise_seeds(shard))
                running[pool.submit(job.next())] = job
            if not running:
                return
            for task in wait(running, return_when=FIRST_COMPLETED).done:
                job, outcome = running.pop(task), pool.outcome(task)
                if isinstance(outcome, Rendered):
                    lost = 0
                elif job.alone:
                    lost += 1
                if lost == _MOST_LOST:
                    raise RenderError(
                        f"{renderer.name} failed in its worker {lost} times in a row, perhaps for "
                        f"lack of memory; try fewer workers; the last time: {_reason(outcome)}"
                    )
                job.take(outcome)
                if len(job.images) == len(job.points):
                    yield job.shard, job.images
                else:
                    running[pool.submit(job.next())] = job
    finally:
        pool.close()


@dataclass
class _Job:
    """A shard: its points (n, d), their seeds, and the images that are there.

    alone: whether they are rendered one by one.
    """

    shard: int
    points: Float64
    seeds: list[int]
    images: list[Small] = field(default_factory=list)
    alone: bool = False

    def next(self) -> _Points:
        """What is to be rendered now."""
        first = len(self.images)
        last = first + 1 if self.alone else None
        return _Points(self.points[first:last], self.seeds[first:last])

    def take(self, outcome: Outcome) -> None:
        """Take the images; of a worker that died: try one by one, or know which one it was."""
        if isinstance(outcome, Rendered):
            self.images += outcome.image
        elif self.alone:
            self.images.append(_reason(outcome))
        else:
            self.alone = True


def _reason(outcome: Outcome) -> str:
    return outcome.reason if isinstance(outcome, Failed) else ""


def check_picklable(renderer: Renderer) -> None:
    """Raise OptionError unless the renderer can be sent to other processes."""
    _pool(renderer, (1, 1), 1)


def _pool(renderer: Renderer, size: tuple[int, int], workers: int) -> Processes:
    try:
        return Processes(_Shards(renderer, size), workers)
    except Exception as error:
        raise OptionError(
            f"{renderer.name} cannot be sent to other processes ({error}): make what it needs "
            "inside of it, or take workers=1"
        ) from error


# -- in a worker -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Points:
    """Points (n, d) of the cube, and the noise seed of each."""

    X: Float64
    seeds: list[int]


@dataclass(frozen=True)
class _Shards:
    """Renders several points, for `Processes`."""

    renderer: Renderer
    size: tuple[int, int]

    def __call__(self, points: _Points) -> Outcome:
        start = time.perf_counter()
        images = self.renderer.small(points.X, points.seeds, self.size)
        return Rendered(images, time.perf_counter() - start)
