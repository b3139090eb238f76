"""Kills, full disks, folders that vanish, clocks that jump: the run goes on to the same result."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_plugins.errors import RenderError
from fide_plugins.recording.record import Progress
from fide_plugins.types import Float32, Float64

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")

KILLS = int(os.environ.get("FIDE_KILLS", "6"))
BUDGET, SIZE, DIM = 220, 6, 3


class Blur:
    """A task that renders at once, with noise of its own."""

    name = "blur"
    dim = DIM

    def __init__(self) -> None:
        self.target = self.render(np.full((1, DIM), 0.7), seed=[0])[0]

    def render(self, X: Float64, seed: Any = None) -> Float32:
        weights = np.random.default_rng(3).standard_normal((DIM, SIZE * SIZE * 3))
        noise = np.array([np.random.default_rng(s).random(SIZE * SIZE * 3) for s in seed])
        images = 1 / (1 + np.exp((0.5 - X) @ weights)) + 0.01 * noise
        return np.clip(images, 0, 1).astype(np.float32).reshape(len(X), SIZE, SIZE, 3)


def run(out: Path | None, on_progress: Callable[[Progress], None] | None = None) -> Any:
    prepared = harness.prepare(
        Blur(), "fide", "mse", BUDGET, 5, out=out, resume=True, checkpoint_every=0,
        options={"popsize": 7}, keep=harness.Keep(summary=False),
    )  # fmt: skip
    return prepared.execute(on_progress)


def in_a_child(work: Callable[[int], object]) -> int:
    """Start a process that does the work with the end of a pipe, and return the pipe's other end.

    The pipe says how many evaluations were told.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child:
        os.close(writing)
        CHILDREN[reading] = child
        return reading
    code = 1
    try:
        work(writing)
        code = 0
    except OSError as error:
        os.write(writing, f"error {error}\n".encode())
    finally:
        os._exit(code)


CHILDREN: dict[int, int] = {}


def end_of(reading: int) -> tuple[int, list[str]]:
    """Exit code of a child (negative: the signal) and the lines it wrote."""
    with os.fdopen(reading, "rb") as pipe:
        lines = pipe.read().decode().splitlines()
    return os.waitstatus_to_exitcode(os.waitpid(CHILDREN.pop(reading), 0)[1]), lines


def reporting(pipe: int) -> Callable[[Progress], None]:
    def report(progress: Progress) -> None:
        os.write(pipe, b"%d\n" % progress.evaluations)

    return report


def kill_at_the_call(number: int, pipe: int) -> None:
    """Let this process die at its n-th call that changes files."""
    calls = 0

    def lethal(function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == number:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **kwargs)

        return call

    for name in ("open", "fsync", "replace", "unlink"):
        setattr(os, name, lethal(getattr(os, name)))


def told_and_kept(lines: list[str], out: Path) -> tuple[int, int]:
    """Evaluations that were told before the kill, and that the directory has after it."""
    told = int(lines[-1]) if lines else 0
    kept: list[int] = []
    prepared = harness.prepare(
        Blur(), "fide", "mse", BUDGET, 5, out=out, resume=True, checkpoint_every=0,
        options={"popsize": 7}, keep=harness.Keep(summary=False),
    )  # fmt: skip
    kept.append(prepared.progress.evaluations)
    return told, kept[0]


def check_same(result: Any, expected: Any) -> None:
    np.testing.assert_array_equal(result.losses, expected.losses)
    np.testing.assert_array_equal(result.x_best, expected.x_best)
    np.testing.assert_array_equal(result.x_recommended, expected.x_recommended)
    np.testing.assert_array_equal(result.image, expected.image)


@pytest.fixture(scope="module")
def expected() -> Any:
    return run(None)


@pytest.mark.thorough
def test_killed_at_any_time(tmp_path: Path, expected: Any) -> None:
    """By the clock and between any two changes of files: what was told is there afterwards."""
    rng, kills, before = random.Random(0), 0, 0
    while kills < KILLS:
        number = rng.randrange(1, 60) if kills % 2 else 0

        def work(pipe: int, number: int = number) -> None:
            if number:
                kill_at_the_call(number, pipe)
            run(tmp_path / "run", reporting(pipe))

        reading = in_a_child(work)
        if not number:
            time.sleep(rng.uniform(0.0, 0.3))
            os.kill(CHILDREN[reading], signal.SIGKILL)
        code, lines = end_of(reading)
        if code == 0:  # it was faster: once more from the beginning
            shutil.rmtree(tmp_path / "run")
            before = 0
            continue
        assert code == -signal.SIGKILL, lines
        kills += 1
        told, kept = told_and_kept(lines, tmp_path / "run")
        saved = int(lines[-2]) if len(lines) > 1 else 0  # all but the piece that was being saved
        assert kept >= max(before, saved), (told, kept)
        before = kept
    check_same(run(tmp_path / "run"), expected)
    assert not list(tmp_path.glob("run/.*.tmp")), "what a killed writer leaves is cleared"


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*holds results of:RuntimeWarning")  # what fitted on the disk
@pytest.mark.parametrize("most", [0, 900, 5_000, 12_000])
def test_a_disk_that_is_full(most: int, tmp_path: Path, expected: Any) -> None:
    """No file may grow beyond so many bytes."""

    def work(pipe: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        run(tmp_path / "run", reporting(pipe))

    code, lines = end_of(in_a_child(work))
    assert code == 1 and "cannot write" in lines[-1] and str(tmp_path) in lines[-1]
    assert not list(tmp_path.glob("run/.*.tmp"))
    check_same(run(tmp_path / "run"), expected)


def test_a_renderer_that_fails_is_what_is_said_also_where_nothing_can_be_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Blur, X: Float64, seed: Any = None) -> Float32:
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        raise ValueError("out of paint")

    def begin_to_fail(progress: Progress) -> None:
        monkeypatch.setattr(Blur, "render", fail)

    with pytest.raises(RenderError, match="out of paint"):
        run(tmp_path / "run", begin_to_fail)
