"""Fills a store of renders, in this process, in several, or on a cluster; counts what fails."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass, field
from multiprocessing import current_process

import numpy as np

from fide_plugins.errors import FideError, OptionError, RenderError
from fide_plugins.fitting.processes import Processes
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered, Task
from fide_plugins.fitting.workers import DAEMON, Workers, workers_for
from fide_plugins.learning.renders import SHARD, BatchRenderer, Pixels, RenderStore, Small
from fide_plugins.types import Float64

_FEW = 500  # renders that say that a renderer must be mended


@dataclass
class Tally:
    """Counts what a renderer has made in this call.

    name: of the renderer.  failed: of each shard, how many renders.
    """

    name: str
    failed: dict[int, int] = field(default_factory=dict)
    _why: str = ""
    _first: Pixels | None = None
    _equal: bool = True

    def add(self, shard: int, images: Sequence[Small], failed: int) -> None:
        """Add a shard: its images, of which so many failed."""
        self.failed[shard] = failed
        reasons = (image.reason for image in images if isinstance(image, Failed))
        self._why = self._why or next(reasons, "")
        for image in images:
            if self._equal and not isinstance(image, Failed):
                self._first = image if self._first is None else self._first
                self._equal = np.array_equal(image, self._first)

    def check(self) -> None:
        """Raise RenderError where enough renders say that the renderer must be mended."""
        tried, failed = SHARD * len(self.failed), sum(self.failed.values())
        if tried < _FEW:
            return
        if 2 * failed > tried:
            raise RenderError(
                f"{self.name} failed for {failed} of {tried} random parameters, or gave no image: "
                f"mend it, or make the ranges of its parameters smaller; the first one: {self._why}"
            )
        if self.image is not None:
            raise all_equal(self.name, tried - failed)

    @property
    def image(self) -> Pixels | None:
        """The image (H, W, 3) that all renders are; None if they differ."""
        return self._first if self._equal else None

    @property
    def with_failures(self) -> list[int]:
        """Shards in which renders have failed."""
        return [shard for shard, failed in self.failed.items() if failed]


def all_equal(name: str, renders: int) -> RenderError:
    """Error of a renderer of that name whose images say nothing of its parameters."""
    return RenderError(
        f"the images of {name} for {renders} random parameters are all equal, in 8 bits and at the "
        "size that is learned: mend it, change the ranges of its parameters (what they change may "
        "be out of view), or give a larger size"
    )


def too_few(there: int, least: int, failed: int, renders: int) -> FideError:
    """Error that names what is missing: renders that succeed, renders at all, or time for them.

    there: renders, of which `least` are needed.  failed: other ones.  renders: asked for.
    """
    few = f"{there} renders are too few to learn from (at least {least})"
    if failed == 0:
        return OptionError(f"{few}; allow more time")
    return RenderError(
        f"{few}: {failed} of {there + failed} failed; mend the renderer, make the ranges of its "
        f"parameters smaller, or ask for more than {renders} renders"
    )


_LOOK = 5.0  # seconds of waiting, after which it is asked whether there still is a cluster
_GO_ON = "and go on with what was rendered"
_LOST = f"the scheduler of the Dask cluster is lost: start it again, {_GO_ON}"
_MOST_LOST = 10  # single renders that end their worker, without another one in between


def fill(
    store: RenderStore,
    renderer: BatchRenderer,
    renders: int,
    *,
    workers: int = 1,
    executor: object = None,
    seconds: float | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> None:
    """Render what is missing of `renders`.

    workers: processes, 0 and 1: this one; with more than one the renderer must be picklable, and a
        render that ends its process (for lack of memory, say) is one that failed.
    executor: renders in their place, see `fitting.workers.choice.workers_for`; None: processes.
        workers says how many shards it gets at a time.
    seconds: no shard is begun after this time; None: no limit.
    on_progress: called with the number of renders done so far.

    Raises RenderError if most renders fail, or workers die again and again; OptionError if the
    renderer cannot be sent to workers, or this process may start none.  RenderError, too, if the
    first 500 renders of this call, or more, are all equal.  What was rendered before an error
    stays, but for shards of this call in which renders have failed, and all of that one image:
    they are rendered again by the next call.
    """
    missing = store.missing(renders)
    done, tally = renders - SHARD * len(missing), Tally(renderer.name)
    stop = None if seconds is None else time.monotonic() + seconds
    if workers > 1 or executor is not None:
        jobs = _Jobs(_pool(renderer, store.size, workers, executor), executor)
        shards = _in_workers(store, renderer, missing, stop, jobs)
    else:
        shards = _in_this_process(store, renderer, missing, stop)
    try:
        for shard, images in shards:
            tally.add(shard, images, store.write(shard, images))
            done += SHARD
            tally.check()
            if on_progress is not None:
                on_progress(min(max(done, 0), renders))
    except RenderError:
        store.remove(tally.with_failures)
        if tally.image is not None:
            store.remove_image(tally.image)
        raise


def _in_this_process(
    store: RenderStore, renderer: BatchRenderer, missing: Sequence[int], stop: float | None
) -> Iterator[tuple[int, list[Small]]]:
    for shard in missing:
        if stop is not None and time.monotonic() > stop:
            return
        seeds = store.noise_seeds(shard)
        yield shard, renderer.small(store.parameters(shard), seeds, store.size)


def _in_workers(
    store: RenderStore,
    renderer: BatchRenderer,
    missing: Sequence[int],
    stop: float | None,
    jobs: _Jobs,
) -> Iterator[tuple[int, list[Small]]]:
    """As `_in_this_process`, in the workers of a pool.

    A shard whose worker dies is rendered again, one by one, to know which render it was.
    """
    waiting, lost = deque(missing), 0
    try:
        while True:
            while waiting and jobs.free and not (stop is not None and time.monotonic() > stop):
                shard = waiting.popleft()
                jobs.add(_Job(shard, store.parameters(shard), store.noise_seeds(shard)))
            jobs.start()
            if not jobs.running:
                return
            for job, outcome in jobs.wait():
                if isinstance(outcome, Rendered):
                    lost = 0
                elif job.alone:
                    lost += 1
                if lost == _MOST_LOST:
                    why = outcome.reason if isinstance(outcome, Failed) else ""
                    raise RenderError(
                        f"{renderer.name} failed in its worker {lost} times in a row, perhaps for "
                        f"lack of memory; try fewer workers; the last time: {why}"
                    )
                job.take(outcome, jobs.only)
                if len(job.images) == len(job.points):
                    yield job.shard, job.images
                else:
                    jobs.add(job)
    finally:
        jobs.close()


class _Jobs:
    """Shards under way in a pool, and those that wait for a worker.

    Processes of our own die one by one.  With a worker of another pool (Dask's) whatever it had
    rendered or was to render is lost, too.  So a single render that was lost there is a suspect: it
    is rendered again while nothing else is.
    """

    def __init__(self, pool: Workers, executor: object) -> None:
        self._pool, self._executor = pool, executor
        self._each_by_itself = isinstance(pool, Processes)
        self.running = dict[Task, _Job]()
        self._next, self._suspects = deque[_Job](), deque[_Job]()
        self.only = self._each_by_itself
        """Whether what was lost now was lost by its own fault."""

    @property
    def free(self) -> bool:
        """Whether another shard can begin."""
        here = len(self.running) + len(self._next)
        return not self._suspects and not self._one_by_one and here < self._pool.number

    @property
    def _one_by_one(self) -> bool:
        return any(job.suspect for job in self.running.values())

    def add(self, job: _Job) -> None:
        """Begin with a shard, or go on with it, as soon as that is possible; see `start`."""
        (self._suspects if job.suspect else self._next).append(job)

    def start(self) -> None:
        """Start what can be."""
        if self._one_by_one:
            return
        if self._suspects:
            if not self.running:
                self._start(self._suspects.popleft())
            return
        while self._next and len(self.running) < self._pool.number:
            self._start(self._next.popleft())

    def wait(self) -> list[tuple[_Job, Outcome]]:
        """Outcomes of those that are done; at least one.

        Raises RenderError if the client of a cluster has given up its scheduler.
        """
        while not (done := wait(self.running, _LOOK, return_when=FIRST_COMPLETED).done):
            if self._lost:
                raise RenderError(_LOST)
        self.only = self._each_by_itself or self._one_by_one
        return [(self.running.pop(task), self._pool.outcome(task)) for task in done]

    def close(self) -> None:
        """Stop what is under way."""
        if not self._lost:  # else nobody is there who could
            self._pool.close()

    @property
    def _lost(self) -> bool:
        """Whether a client of Dask has given up its scheduler: its futures wait for ever."""
        return getattr(self._executor, "status", None) == "closed"

    def _start(self, job: _Job) -> None:
        try:
            task = self._pool.submit(job.next())
        except Exception as error:  # of the user's executor
            why = f"the executor takes no more renders ({error!r}): give another one"
            raise RenderError(_LOST if self._lost else f"{why}, {_GO_ON}") from error
        self.running[task] = job


@dataclass
class _Job:
    """A shard: its points (n, d), their seeds, and the images that are there.

    alone: whether they are rendered one by one.
    suspect: whether the next one was lost, and perhaps by the fault of another.
    """

    shard: int
    points: Float64
    seeds: list[int]
    images: list[Small] = field(default_factory=list)
    alone: bool = False
    suspect: bool = False

    def next(self) -> _Points:
        """What is to be rendered now."""
        first = len(self.images)
        last = first + 1 if self.alone else None
        return _Points(self.points[first:last], self.seeds[first:last])

    def take(self, outcome: Outcome, only: bool) -> None:
        """Take the images; of a worker that died: try one by one, or know which one it was.

        only: whether a render that was lost was lost by its own fault.
        """
        if isinstance(outcome, Rendered):
            self.images += outcome.image
        elif self.alone and only:
            self.images.append(outcome)
        else:
            self.suspect, self.alone = self.alone, True
            return
        self.suspect = False


def check_workers(renderer: BatchRenderer, workers: int, executor: object = None) -> None:
    """Raise OptionError unless the renderer can be sent to processes, or to what `executor` is.

    Also in a daemonic process, which can start no workers.

    workers: as for `fill`; an executor needs at least one.
    """
    _pool(renderer, (1, 1), workers, executor)


def _pool(
    renderer: BatchRenderer, size: tuple[int, int], workers: int, executor: object
) -> Workers:
    if executor is None and workers > 1 and current_process().daemon:
        raise OptionError(f"{DAEMON}; give workers=0")
    shards = _Shards(renderer, size)
    try:
        if executor is None:
            return Processes(shards, workers)
        return workers_for(shards, workers, executor, None)
    except OptionError:  # of what executor is
        raise
    except Exception as error:
        otherwise = "take workers=1" if executor is None else "leave out executor"
        raise OptionError(
            f"{renderer.name} cannot be sent to other processes ({error}): make what it needs "
            f"inside of it, or {otherwise}"
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

    renderer: BatchRenderer
    size: tuple[int, int]

    def __call__(self, points: _Points) -> Outcome:
        start = time.perf_counter()
        images = self.renderer.small(points.X, points.seeds, self.size)
        return Rendered(images, time.perf_counter() - start)
