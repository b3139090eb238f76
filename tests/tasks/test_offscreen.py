"""Drawing without a screen: what is missing, threads, processes, and memory."""

from __future__ import annotations

import contextlib
import gc
import pickle
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_lab.cli import doctor_command
from fide_tasks import robot
from fide_tasks.offscreen import OffscreenError
from fide_tasks.robot import Robot

pytestmark = pytest.mark.usefixtures("opengl")


@pytest.fixture(scope="module")
def task() -> Robot:
    return Robot(64)


def random_x(n: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random((n, 7))


def test_missing_libraries_are_named(render_elsewhere: Callable[..., str | None]) -> None:
    remedy = "apt-get install libegl1 libgl1-mesa-dri"
    nothing = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}
    for environment in (nothing, {"MUJOCO_GL": "egl", **nothing}, {"MUJOCO_GL": "osmesa"}):
        line = render_elsewhere(environment)
        assert line is not None
        assert line.startswith(
            ("fide_tasks.offscreen.OffscreenError: MuJoCo", "ImportError: MuJoCo")
        )
        assert remedy in line


def test_fide_doctor_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_command, "names", lambda kind: ["robot"])
    assert doctor_command.problems("tasks") == {"robot": None}
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    problem = doctor_command.problems("tasks")["robot"]
    assert problem is not None
    assert "apt-get install libegl1 libgl1-mesa-dri" in problem


def test_a_driver_that_crashes_does_so_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot, "_CHECK", "import os; os.abort()")
    with pytest.raises(OffscreenError, match=r"no frame was drawn: it aborts .* .signal 6."):
        Robot(8).check()


def test_without_mujoco_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install mujoco .*extra robot"):
        fide_tasks.make("robot")


def test_an_image_too_large_for_opengl_is_an_error_and_others_still_work(task: Robot) -> None:
    before = task.render(random_x(1))
    with pytest.raises(OffscreenError, match="images of 8 x 100000 pixels .*smaller size"):
        Robot((8, 100_000)).render(random_x(1))
    np.testing.assert_array_equal(task.render(random_x(1)), before)


@pytest.mark.parametrize("size", [64, (8, 100_000)], ids=["drawn", "failed"])
def test_a_task_that_is_collected_leaves_the_frame_of_another_one_alone(
    task: Robot, monkeypatch: pytest.MonkeyPatch, size: Any
) -> None:
    X, pose, calls = random_x(4), Robot._pose, []
    expected = task.render(X)
    lost: Any = Robot(size)
    with contextlib.suppress(OffscreenError):
        lost.render(X[:1])
    lost.itself = lost  # a cycle, such as the traceback of an error makes
    there = weakref.ref(lost)
    gc.disable()
    del lost

    def pose_and_collect(self: Robot, *arguments: Any) -> None:
        calls.append(1)
        if len(calls) == 3:
            gc.collect()
        pose(self, *arguments)

    monkeypatch.setattr(Robot, "_pose", pose_and_collect)
    try:
        images = task.render(X)
    finally:
        gc.enable()
    assert there() is None
    np.testing.assert_array_equal(images, expected)
    np.testing.assert_array_equal(task.render(X), expected)


def test_threads_take_turns(task: Robot) -> None:
    X, wrong = random_x(5, 9), []
    expected, other = task.render(X), Robot(64)

    def work(one: Robot) -> None:
        for _ in range(20):
            if not np.array_equal(one.render(X), expected):
                wrong.append(one)

    threads = [threading.Thread(target=work, args=(one,)) for one in (task, task, other)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


PROCESSES = """
import multiprocessing
import numpy as np
from fide_tasks.robot import Robot

X = np.random.default_rng(0).random((3, 7))
task = Robot(64)
expected = task.render(X)  # this process draws first
context = multiprocessing.get_context(METHOD)
with context.Pool(2) as pool:
    sent = [pool.apply_async(one.render, (X,)) for one in (task, Robot(64))]
    for result in sent:
        np.testing.assert_array_equal(result.get(timeout=60), expected)
np.testing.assert_array_equal(task.render(X), expected)
"""


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_processes_have_contexts_of_their_own(method: str) -> None:
    alone(PROCESSES.replace("METHOD", repr(method)))


def alone(script: str) -> str:
    """Output of a script in a process of its own: contexts of other libraries outlive no fork."""
    done = subprocess.run(
        [sys.executable, "-c", script], timeout=250, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_closing_frees_and_the_next_render_opens_again(task: Robot) -> None:
    one = Robot(64)
    images = one.render(random_x(2))
    stage = one._stage
    assert stage is not None
    one.close()
    one.close()
    assert not stage._finalizer.alive
    np.testing.assert_array_equal(one.render(random_x(2)), images)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(one)).render(random_x(2)), images)
