"""Render processes: the same images, and a clear error when one dies or hangs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_lab import run as harness
from fide_plugins.errors import RenderError
from fide_tasks import mitsuba_task, render_workers
from fide_tasks.render_workers import RenderWorkerError

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")


def make(workers: int, **options: Any) -> Any:
    """A task whose processes start fast: LLVM would compile the scene in each."""
    settings = {"size": 24, "spp": 2, "reference_spp": 64, "variant": "scalar", **options}
    return fide_tasks.make("beads", workers=workers, **settings)


def random_x(n: int) -> NDArray[np.float64]:
    return np.random.default_rng(0).random((n, 18))


@pytest.fixture(scope="module")
def shared() -> Iterator[Any]:
    task = make(2)
    yield task
    if task._pool is not None:
        task._pool.close()


def pids(task: Any) -> list[int]:
    """Process ids, when all processes have loaded the scene and wait for work."""
    task.render(random_x(1), seed=0)
    while not all(worker.idle for worker in task._pool._workers):
        task.render(random_x(1), seed=0)  # by one that is ready; the others are looked at
    found: list[int] = task._pool.pids
    return found


@pytest.mark.thorough
def test_images_do_not_depend_on_the_number_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two, X = make(1, variant="auto"), make(2, variant="auto"), random_x(9)
    np.testing.assert_array_equal(two.render(X, seed=4), one.render(X, seed=4))
    assert len(set(pids(two))) == 2
    assert os.getpid() not in pids(two)
    monkeypatch.setattr(mitsuba_task, "_CHUNK", 7 * 24 * 24)  # a reference of ten chunks
    np.testing.assert_array_equal(two.reference(X[0]), one.reference(X[0]))
    np.testing.assert_array_equal(two.target, one.target)
    np.testing.assert_array_equal(two.noise_level(X[0]), one.noise_level(X[0]))
    assert two.render(X[:0]).shape == (0, 24, 24, 3)


def test_a_killed_process_is_an_error_at_once_and_the_next_render_works(shared: Any) -> None:
    expected = shared.render(random_x(3), seed=1)
    victim = pids(shared)[0]
    os.kill(victim, signal.SIGKILL)
    start = time.monotonic()
    with pytest.raises(RenderWorkerError, match=rf"pid {victim}\) died .*signal 9.*starts new"):
        shared.render(random_x(40))
    assert time.monotonic() - start < 5
    assert issubclass(RenderWorkerError, RuntimeError)
    np.testing.assert_array_equal(shared.render(random_x(3), seed=1), expected)
    assert victim not in pids(shared)


@pytest.mark.thorough
def test_a_process_that_is_stopped_is_an_error(
    shared: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    victim = pids(shared)[0]
    monkeypatch.setattr(render_workers, "SILENCE_SECONDS", 2.0)
    os.kill(victim, signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(RenderWorkerError, match=rf"pid {victim}\) hangs: it is stopped, .* 2 s"):
        shared.render(random_x(1))  # one frame, so that no other process can be late
    assert 2 <= time.monotonic() - start < 30
    monkeypatch.undo()
    shared.render(random_x(2))


STUCK = """
import contextlib, os, signal, sys, threading, time
sys.path[:0] = {path}
import numpy as np
from fide_tasks import render_workers as rw

rw.SILENCE_SECONDS = rw.LOADING_SILENCE_SECONDS = 2.0
rw.PATIENCE_SECONDS, rw.COMPILING_SECONDS, rw._SECONDS_A_PATH = 2.0, 0.0, 1e-9


class Artist:
    def __init__(self, case):
        self.case, self.times = case, dict.fromkeys(("load", "update", "render", "copy"), 0.0)

    @contextlib.contextmanager
    def open(self):
        if self.case == "loading":
            os.kill(os.getpid(), signal.SIGSTOP)
        yield

    def draw(self, job, out):
        out[:] = job.seed
        self.times["render"] += 4 if self.case == "slow" else 0
        if job.seed == 0:
            return
        if self.case == "sending":
            threading.Timer(0.002, os.kill, (os.getpid(), signal.SIGSTOP)).start()
        if self.case == "drawing":
            time.sleep(1000)
        if self.case == "raising":
            raise ValueError("x" * 10**6)
        if self.case == "slow":
            time.sleep(4)


if __name__ == "__main__":
    for case, side in [
        ("loading", 8), ("sending", 1500), ("drawing", 8), ("raising", 8), ("slow", 2000)
    ]:
        pool = rw.RenderWorkers(Artist(case), 1, (side, side, 3))
        out = np.full((2, side, side, 3), 7, np.float32)
        start = time.monotonic()
        try:
            for frame in range(2):
                pool.render([rw.Job(np.zeros(1), frame, 1, True)], out[frame : frame + 1])
            time.sleep(0.1)
            if case != "slow":
                pool.render([rw.Job(np.zeros(1), 2, 1, True)], out[:1])
            print(case, "ended", out[1].min(), out[1].max())
        except Exception as error:
            print(case, type(error).__name__, time.monotonic() - start < 30, str(error)[:80])
        pool.close()
"""


@pytest.mark.thorough
def test_wherever_a_process_gets_stuck_it_is_noticed(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(STUCK.replace("{path}", repr([p for p in sys.path if p])))
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=240)
    lines = [line.split(maxsplit=3) for line in run.stdout.splitlines()]
    assert [line[:3] for line in lines] == [
        ["loading", "RenderWorkerError", "True"],
        ["sending", "RenderWorkerError", "True"],
        ["drawing", "RenderWorkerError", "True"],
        ["raising", "RenderWorkerError", "True"],
        ["slow", "ended", "1.0"],
    ], run.stdout + run.stderr
    assert "it is stopped, or stuck" in lines[0][3]
    assert "it is stopped, or stuck" in lines[1][3]
    assert "nothing came of it for 2 s" in lines[2][3]
    assert "ValueError('xxx" in lines[3][3]


class Idle:
    """A process that was never started."""

    made = 0
    ended = 0
    idle, frame = True, None

    def __init__(self, *arguments: Any) -> None:
        self.pipe = self.process = self
        Idle.made += 1

    def send(self, job: Any, index: int, patience: float) -> None:
        """Nothing is drawn."""

    def kill(self) -> None:
        Idle.ended += 1

    def close(self) -> None:
        """There is no pipe."""

    def join(self, timeout: float) -> None:
        """It has ended."""


def test_processes_that_were_started_end_where_another_one_cannot_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Second(Idle):
        def __init__(self, *arguments: Any) -> None:
            if Idle.made:
                raise OSError("Cannot allocate memory")
            super().__init__()

    monkeypatch.setattr(Idle, "made", 0)
    monkeypatch.setattr(Idle, "ended", 0)
    monkeypatch.setattr(render_workers, "_Worker", Second)
    with pytest.raises(RenderWorkerError, match=r"process 2 of 3 .*allocate memory.*fewer workers"):
        render_workers.RenderWorkers(make(1), 3, (8, 8, 3))
    assert (Idle.made, Idle.ended) == (1, 1)


def test_an_error_in_a_process_is_raised_here() -> None:
    task = make(2)
    task.variant = "llvm_ad_nonsense"
    with pytest.raises((ImportError, ValueError, AttributeError), match="nonsense"):
        task.render(random_x(2))
    assert task._pool.closed


def test_processes_end_with_the_task_and_with_its_process(
    tmp_path: Path, ends: Callable[[int], bool]
) -> None:
    task = make(2)
    alive = pids(task)
    del task
    assert all(map(ends, alive))
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys; sys.path[:0] = {[p for p in sys.path if p]}\n"
        "import os, fide_tasks\n"
        "if __name__ == '__main__':\n"
        "    task = fide_tasks.make('beads', size=8, spp=1, workers=2, variant='scalar')\n"
        "    task.render([[0.5] * 18] * 2)\n"
        "    print(*task._pool.pids, flush=True)\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert run.returncode == -9
    orphans = [int(word) for word in run.stdout.split()]
    assert len(orphans) == 2
    assert all(map(ends, orphans))


def test_a_run_whose_renderer_was_killed_is_resumed(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"optimizer": "cma", "budget": 45, "seed": 1, "checkpoint_every": 0}
    whole = harness.run(make(1, reference_spp=16), **settings)
    task = make(2, reference_spp=16)

    def kill(progress: harness.Progress) -> None:
        if progress.evaluations >= 20:
            os.kill(task._pool.pids[0], signal.SIGKILL)

    start = time.monotonic()
    with pytest.raises(RenderError, match=r"beads failed to render candidates.*pid \d+\) died"):
        harness.run(task, **settings, on_progress=kill, out=tmp_path)
    assert time.monotonic() - start < 20
    resumed = harness.run(make(1, reference_spp=16), **settings, out=tmp_path, resume=True)
    assert resumed.losses.tolist() == whole.losses.tolist()
    assert resumed.reference_loss == whole.reference_loss
