"""Fills a store of renders, in this process or in several."""

from __future__ import annotations

import multiprocessing
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.learning.renderer import Pixels, Renderer
from fide_plugins.learning.store import SHARD, RenderStore
from fide_plugins.types import Float64

__all__ = ["fill"]

_FEW = 500  # renders before a renderer can be given up
_TRIES = 3  # of a shard whose worker was killed
_AHEAD = 2  # shards that wait for each worker


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

    workers: processes; with more than one the renderer must be picklable.
    seconds: no shard is begun after this time; None: no limit.
    on_progress: called with the number of renders done so far.

    Raises RenderError if most renders fail, or workers are killed again and again; OptionError if
    the renderer cannot be sent to workers.  What was rendered before an error stays.
    """
    missing = store.missing(renders)
    done, failed, tried = renders - SHARD * len(missing), 0, 0
    stop = None if seconds is None else time.monotonic() + seconds
    shards = _in_workers if workers > 1 else _here
    for shard, images in shards(store, renderer, missing, stop, workers):
        failed += store.write(shard, images)
        tried, done = tried + SHARD, done + SHARD
        if tried >= _FEW and 2 * failed > tried:
            raise RenderError(
                f"{renderer.name} failed for {failed} of {tried} random parameters, or gave no "
                "image: mend it, or make the ranges of its parameters smaller"
            )
        if on_progress is not None:
            on_progress(min(max(done, 0), renders))
    return failed


def _here(
    store: RenderStore, renderer: Renderer, missing: Sequence[int], stop: float | None, workers: int
) -> Iterator[tuple[int, list[Pixels | None]]]:
    for shard in missing:
        if stop is not None and time.monotonic() > stop:
            return
        yield shard, renderer.small(store.parameters(shard), store.size)


def _in_workers(
    store: RenderStore, renderer: Renderer, missing: Sequence[int], stop: float | None, workers: int
) -> Iterator[tuple[int, list[Pixels | None]]]:
    """As `_here`, in processes; a pool that a killed worker broke is made again."""
    _check_picklable(renderer)
    left, tries = list(missing), 0
    while left:
        try:
            for shard, images in _by_one_pool(store, renderer, left, stop, workers):
                left.remove(shard)
                tries = 0
                yield shard, images
            return
        except BrokenProcessPool as error:
            tries += 1
            if tries == _TRIES:
                raise RenderError(
                    f"workers that run {renderer.name} were killed {_TRIES} times in a row, "
                    "perhaps for lack of memory; try workers=1"
                ) from error


def _by_one_pool(
    store: RenderStore, renderer: Renderer, shards: Sequence[int], stop: float | None, workers: int
) -> Iterator[tuple[int, list[Pixels | None]]]:
    context = multiprocessing.get_context("spawn")
    waiting, running = list(shards), dict[Future[list[Pixels | None]], int]()
    pool = ProcessPoolExecutor(workers, context, _take_renderer, (renderer, store.size))
    try:
        while waiting or running:
            late = stop is not None and time.monotonic() > stop
            while waiting and len(running) < _AHEAD * workers and not late:
                shard = waiting.pop(0)
                running[pool.submit(_render, store.parameters(shard))] = shard
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _check_picklable(renderer: Renderer) -> None:
    try:
        pickle.dumps(renderer)
    except Exception as error:
        raise OptionError(
            f"{renderer.name} cannot be sent to other processes ({error}): define it at the top "
            "of a module, or take workers=1"
        ) from error


# -- in a worker -----------------------------------------------------------------------------------

_worker: list[tuple[Renderer, tuple[int, int]]] = []


def _take_renderer(renderer: Renderer, size: tuple[int, int]) -> None:
    _worker[:] = [(renderer, size)]


def _render(X: Float64) -> list[Pixels | None]:
    renderer, size = _worker[0]
    return renderer.small(X, size)
