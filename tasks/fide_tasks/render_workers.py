"""Processes that render frames for a task, with detection of processes that die or hang.

Each candidate goes to an idle process. Frames come back in shared memory. The pipe carries only
short messages, which arrive whole, so no reader waits for the rest of one.

The death of a process is detected at once. A heartbeat thread in each process increments a counter
in shared memory. If it stands still for SILENCE_SECONDS, or LOADING_SILENCE_SECONDS while libraries
load (no Python thread runs then), the process is stopped or stuck. A process with a heartbeat hangs
if loading takes LOADING_SECONDS, or if a frame takes far longer than the slowest path so far
predicts. In all these cases all processes are ended and `RenderWorkerError` is raised; the next
render starts new ones.

The processes belong to the process that started them; a fork of it starts its own.
"""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import signal
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import connection
from typing import Any, NamedTuple, Protocol

import numpy as np

from fide_tasks.base import Image, Vector

__all__ = ["Artist", "Job", "RenderWorkerError", "RenderWorkers", "cores"]

SILENCE_SECONDS = 5.0  # longest pause of a heartbeat
LOADING_SILENCE_SECONDS = 60.0  # the same while libraries load
LOADING_SECONDS = 300.0  # limit for loading the renderer and the scene
COMPILING_SECONDS = 120.0  # additional limit for the first frame with a new number of paths
PATIENCE_SECONDS = 10.0  # limit for any frame, plus _SLOWER times the predicted time
_SLOWER = 20.0  # factor on the time that the slowest path so far predicts
_SECONDS_A_PATH = 2e-6  # time of a path before one was measured
_SLICE = 1.0  # seconds; longer pauses between two checks are pauses of this process
_BEAT = 0.5  # seconds between heartbeats
_LONGEST_WORD = 4096  # bytes that a pipe passes at once
_SAFE_PATH = "PYTHONSAFEPATH"  # read by Python when it starts
_STARTING = threading.Lock()  # the environment belongs to the whole process


class RenderWorkerError(RuntimeError):
    """A process that renders for a task has died or hangs."""


class Job(NamedTuple):
    """One frame: physical values (dim,), noise seed, samples per pixel, whether it is encoded."""

    values: Vector
    seed: int
    spp: int
    encoded: bool


class Artist(Protocol):
    """A renderer that is sent to each process by pickling.

    times: seconds by part; the times of all processes are added to it.
    """

    times: dict[str, float]

    def open(self) -> Any:
        """Load everything and return a context in which `draw` may be called."""

    def draw(self, job: Job, out: Image) -> None:
        """Draw one frame into out, (H, W, 3)."""


class RenderWorkers:
    """A pool of processes, each with its own renderer; for one thread at a time."""

    def __init__(self, artist: Artist, count: int, shape: tuple[int, int, int]) -> None:
        """Start the processes; raises RenderWorkerError if the system cannot start them all."""
        self._artist, self._slowest = artist, _SECONDS_A_PATH
        self._measured, self._pixels = False, shape[0] * shape[1]
        self._workers: list[_Worker] = []
        self._process = os.getpid()
        self._finalizer = weakref.finalize(self, _end, self._workers, self._process)
        context = multiprocessing.get_context("spawn")
        try:
            with _no_code_of_this_folder():
                for _ in range(count):
                    self._workers.append(_Worker(context, artist, shape))
        except BaseException as error:
            self.close()
            if not isinstance(error, OSError):
                raise
            raise RenderWorkerError(
                f"render process {len(self._workers) + 1} of {count} cannot be started ({error}): "
                "choose fewer workers"
            ) from error

    @property
    def pids(self) -> list[int]:
        """Process ids."""
        return [worker.pid for worker in self._workers]

    @property
    def closed(self) -> bool:
        """Whether the processes have ended, or belong to another process."""
        return not self._finalizer.alive or self._process != os.getpid()

    def close(self) -> None:
        """End the processes."""
        self._finalizer()

    def render(self, jobs: Sequence[Job], out: Image) -> None:
        """Draw the jobs into out, (n, H, W, 3).

        Raises RenderWorkerError if a process dies or hangs, and the errors of `draw`. After any
        error all processes are ended.
        """
        try:
            self._render(jobs, out)
        except BaseException:
            self.close()
            raise

    def _render(self, jobs: Sequence[Job], out: Image) -> None:
        waiting = list(enumerate(jobs))[::-1]
        while waiting or any(worker.frame is not None for worker in self._workers):
            for worker in self._workers:
                if waiting and worker.idle:
                    index, job = waiting.pop()
                    paths = job.spp * self._pixels
                    worker.send(job, index, PATIENCE_SECONDS + _SLOWER * self._slowest * paths)
            for worker in self._look():
                self._take(worker, jobs, out)

    def _look(self) -> list[_Worker]:
        """Wait briefly; returns the processes that sent a message or ended.

        Time is counted in slices, so that pauses of this process itself (by Ctrl-Z, for example) do
        not count against the others.
        """
        busy = [worker for worker in self._workers if not worker.idle]
        handles = [h for worker in busy for h in (worker.pipe, worker.process.sentinel)]
        start = time.monotonic()
        ready = set(connection.wait(handles, timeout=_SLICE))
        elapsed = min(time.monotonic() - start, _SLICE)
        speaking = [w for w in busy if w.pipe in ready or w.process.sentinel in ready]
        for worker in busy:
            silence = worker.waited(elapsed)
            if silence is not None and worker not in speaking:
                raise RenderWorkerError(
                    f"a render process (pid {worker.pid}) hangs: {silence}; all render processes "
                    "were ended, and the next render starts new ones"
                )
        return speaking

    def _take(self, worker: _Worker, jobs: Sequence[Job], out: Image) -> None:
        """Receive a message of a process: that it is ready, a frame, or an exception."""
        try:
            word = worker.pipe.recv()
            if isinstance(word, BaseException):
                raise word
        except (EOFError, ConnectionError):
            raise RenderWorkerError(worker.obituary()) from None
        if word is not None:
            assert worker.frame is not None
            out[worker.frame] = worker.image
            self._count(word, jobs[worker.frame].spp * self._pixels)
        worker.frame, worker.idle, worker.loaded = None, True, True

    def _count(self, times: dict[str, float], paths: int) -> None:
        for part, spent in times.items():
            self._artist.times[part] += spent
        slowness = sum(times[part] for part in ("update", "render", "copy")) / paths
        self._slowest = max(self._slowest, slowness) if self._measured else slowness
        self._measured = True


class _Worker:
    """Handle of one process.

    image: its last frame, in shared memory.
    frame: index of the frame it draws; None while it loads or is idle.
    """

    def __init__(self, context: Any, artist: Artist, shape: tuple[int, int, int]) -> None:
        self.pipe, theirs = context.Pipe()
        memory = context.RawArray(ctypes.c_float, math.prod(shape))
        self._pulse = context.RawValue(ctypes.c_uint64)
        self.image: Image = np.frombuffer(memory, np.float32).reshape(shape)
        self.process = context.Process(
            target=_serve, args=(theirs, artist, memory, shape, self._pulse), daemon=True
        )
        self.process.start()
        theirs.close()
        self.pid: int = self.process.pid
        self.frame: int | None = None
        self.idle = self.loaded = False
        self._compiled: set[int] = set()  # numbers of paths
        self._patience = self._granted = LOADING_SECONDS  # what is left of it, and what was given
        self._silence, self._last_pulse = 0.0, 0

    def send(self, job: Job, index: int, patience: float) -> None:
        self.frame, self.idle = index, False
        self._patience = patience + (0.0 if job.spp in self._compiled else COMPILING_SECONDS)
        self._granted, self._silence = self._patience, 0.0
        self._compiled.add(job.spp)
        with suppress(ConnectionError):  # it is dead, as the next look will show
            self.pipe.send(job)

    def waited(self, seconds: float) -> str | None:
        """Add time without a message; returns the reason if the process hangs, else None."""
        self._patience -= seconds
        pulse = self._pulse.value
        still = pulse > 0 and pulse == self._last_pulse  # until its first beat it is not yet there
        self._silence = self._silence + seconds if still else 0.0
        self._last_pulse = pulse
        limit = SILENCE_SECONDS if self.loaded else LOADING_SILENCE_SECONDS
        if self._silence > limit:
            return f"it is stopped, or stuck, for {limit:.0f} s"
        if self._patience < 0:
            return f"nothing came of it for {self._granted:.0f} s"
        return None

    def obituary(self) -> str:
        self.process.join(timeout=5)
        code = self.process.exitcode
        how = f"exit code {code}" if code is None or code >= 0 else f"signal {-code}"
        when = "while it started" if self.frame is None else f"while it drew frame {self.frame}"
        hint = ""
        if self.frame is None and code == 1:
            hint = (
                "; a script that starts processes must do its work under if __name__ == '__main__'"
            )
        return (
            f"a render process (pid {self.pid}) died {when} ({how}){hint}; "
            "all render processes were ended, and the next render starts new ones"
        )


def cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _no_code_of_this_folder() -> Iterator[None]:
    """Within this block, new processes import no module from the current folder.

    It may contain an untrusted scene. After the start they have the import path of this process.
    """
    with _STARTING:
        before = os.environ.get(_SAFE_PATH)
        os.environ[_SAFE_PATH] = "1"
        try:
            yield
        finally:
            del os.environ[_SAFE_PATH]
            if before is not None:
                os.environ[_SAFE_PATH] = before


def _end(workers: list[_Worker], owner: int) -> None:
    if owner != os.getpid():  # a forked process
        return
    for worker in workers:
        worker.process.kill()  # it holds nothing that would have to be saved
        worker.pipe.close()
    for worker in workers:
        worker.process.join(timeout=5)


def _serve(pipe: Any, artist: Artist, memory: Any, shape: tuple[int, int, int], pulse: Any) -> None:
    """Main function of a process: draw the jobs from the pipe until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this one
    threading.Thread(target=_beat, args=(pulse,), daemon=True).start()
    out: Image = np.frombuffer(memory, np.float32).reshape(shape)
    before = dict(artist.times)
    try:
        with artist.open():
            pipe.send(None)
            while True:
                artist.draw(pipe.recv(), out)
                pipe.send({part: spent - before[part] for part, spent in artist.times.items()})
                before = dict(artist.times)
    except (EOFError, ConnectionError):
        pass
    except Exception as error:
        with suppress(ConnectionError):
            pipe.send(_sendable(error))


def _beat(pulse: Any) -> None:
    """Increment the heartbeat counter forever."""
    while True:
        pulse.value += 1
        time.sleep(_BEAT)


def _sendable(error: Exception) -> Exception:
    """The exception itself if it can be pickled, otherwise a RenderWorkerError with its text."""
    import pickle

    with suppress(Exception):
        word = pickle.dumps(error)
        pickle.loads(word)
        if len(word) <= _LONGEST_WORD:
            return error
    return RenderWorkerError(f"a render process failed: {repr(error)[: _LONGEST_WORD // 2]}")
