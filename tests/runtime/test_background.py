"""Work in a thread is never lost sight of."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest

from fide_plugins.runtime import threads
from fide_plugins.runtime.threads import Background


class Gate:
    """Work that is over when it is let."""

    def __init__(self) -> None:
        self.open, self.over = threading.Event(), False

    def __call__(self) -> None:
        assert self.open.wait(20)
        self.over = True


def test_what_begins_while_another_thread_waits_for_the_last_is_waited_for_too() -> None:
    """As a process that forks does, in whatever thread."""
    background, first, second = Background(), Gate(), Gate()
    first.open.set()
    background.start(first, "first")
    work: Any = background._work
    wait = work.wait

    def wait_and_meanwhile_another_begins() -> None:
        wait()
        work.wait = wait
        background.start(second, "second")

    work.wait = wait_and_meanwhile_another_begins
    background.join()
    assert first.over and background.busy
    threading.Timer(0.05, second.open.set).start()
    background.wait()
    assert second.over and not background.busy


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals to a thread")
def test_work_goes_on_after_ctrl_c_and_is_waited_for_again() -> None:
    background, work, me = Background(), Gate(), threading.get_ident()
    background.start(work, "work")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background of
    try:  # a shell are started without it
        threading.Timer(0.1, signal.pthread_kill, (me, signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            background.wait()
    finally:
        signal.signal(signal.SIGINT, before)
    threading.Timer(0.1, work.open.set).start()
    background.wait()
    assert work.over


def test_what_the_last_one_raised_does_not_keep_the_next_from_beginning() -> None:
    background, second = Background(), Gate()

    def fail() -> None:
        raise ArithmeticError("it diverged")

    background.start(fail, "first")
    second.open.set()
    with pytest.raises(ArithmeticError, match="diverged"):
        background.start(second, "second")
    background.wait()
    assert second.over


@pytest.mark.skipif(sys.platform != "linux", reason="only there are threads of the system listed")
def test_a_process_forks_when_the_thread_of_the_work_is_gone() -> None:
    """Libraries clean up when a thread ends, after Python takes it for dead: MKL under a lock."""
    libc = ctypes.CDLL(None)
    exit_later, thread = ctypes.c_uint(), 0
    assert libc.pthread_key_create(ctypes.byref(exit_later), libc.usleep) == 0

    def work() -> None:
        nonlocal thread
        thread = threading.get_native_id()
        assert libc.pthread_setspecific(exit_later, ctypes.c_void_p(200_000)) == 0  # microseconds

    background = Background()
    background.start(work, "work")
    background.wait()
    assert os.path.exists(f"/proc/self/task/{thread}")
    threads._before_fork()
    threads._START.release()
    assert not os.path.exists(f"/proc/self/task/{thread}")
    libc.pthread_key_delete(exit_later)


def test_work_that_another_thread_begins_begins_before_a_fork_or_after_it(
    forked: Callable[[Callable[[], object]], str],
) -> None:
    """A child never finds work under way, which would not go on there; and it can begin some."""
    background, stop = Background(), threading.Event()

    def begin_again_and_again() -> None:
        while not stop.is_set():
            background.start(lambda: stop.wait(0.0005), "work")

    def in_the_child() -> bool:
        idle, work = not background.busy, Gate()
        work.open.set()
        background.start(work, "work of the child")
        background.wait()
        return idle and work.over

    thread = threading.Thread(target=begin_again_and_again)
    thread.start()
    try:
        for _ in range(20):
            assert forked(in_the_child) == "True"
    finally:
        stop.set()
        thread.join()
    background.wait()


def test_no_thread_to_be_had_is_an_error_and_nothing_to_wait_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def none_left(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    background = Background()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", none_left)
        with pytest.raises(RuntimeError, match="new thread"):
            background.start(Gate(), "work")
    background.wait()
    assert not background.busy
