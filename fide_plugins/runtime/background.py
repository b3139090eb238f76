"""Work in a background thread.

The caller must not touch what the work changes until `wait` has returned; then the result does not
depend on the thread.  A process waits for the work before it forks, since a child has one thread
only and would keep half-done work; and for the end of the thread itself, and of those that it made:
MKL gives their memory back then, under a lock that nobody would open in the child.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from weakref import WeakSet

__all__ = ["Background"]


class Background:
    """Runs one piece of work at a time in a background thread."""

    def __init__(self) -> None:
        self._work: _Work | None = None
        self._error: BaseException | None = None
        with _LOCK:
            _ALL.add(self)

    @property
    def busy(self) -> bool:
        """Whether work is running."""
        work = self._work
        return work is not None and not work.done.is_set()

    def start(self, work: Callable[[], object], what: str) -> None:
        """Start `work` when the previous work is done; what: its description, for errors.

        Raises what the previous work raised; the new work has started nevertheless.
        """
        self.join()
        error, self._error = self._error, None
        with _LOCK:  # no process is forked between the two
            self._work = _Work(work, what, self._note)
            self._work.begin()
        if error is not None:
            raise error

    def wait(self) -> None:
        """Return when no work is running; raises, once, what the work raised."""
        self.join()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def join(self) -> None:
        """Return when no work is running; keeps what the work raised for `wait`."""
        work = self._work
        if work is not None and not work.is_here:
            work.wait()  # Ctrl-C may interrupt it; the work then goes on
            with _LOCK:
                if self._work is work:  # no other thread has started new work meanwhile
                    self._work = None

    def _note(self, error: BaseException) -> None:
        self._error = error


class _Work:
    """A thread, and an event that is set at its end.

    `Thread.join` alone takes a thread for dead once it was interrupted (python/cpython#90882).
    """

    def __init__(
        self, work: Callable[[], object], what: str, failed: Callable[[BaseException], None]
    ) -> None:
        self._work, self._what, self._failed = work, what, failed
        self.done = threading.Event()
        self._thread = threading.Thread(target=self._run, name=what)

    @property
    def is_here(self) -> bool:
        """Whether the current thread does this work."""
        return self._thread is threading.current_thread()

    def begin(self) -> None:
        """Start the thread; raises RuntimeError if the system has no more threads."""
        try:
            self._thread.start()
        except BaseException:
            self.done.set()
            raise

    def wait(self) -> None:
        """Return when the work is done and the thread has ended."""
        self.done.wait()
        if self._thread.ident is not None:  # the thread has started
            self._thread.join()

    def _run(self) -> None:
        before = _threads()
        try:
            self._work()
        except BaseException as error:
            error.add_note(f"raised in the background, by {self._what}")
            self._failed(error)
        finally:
            now = _threads()
            _ENDING.intersection_update(now)
            _ENDING.update(now - before, {str(threading.get_native_id())})
            self.done.set()


def _threads() -> set[str]:
    """The system's names of all threads of this process; none where it does not list them."""
    with suppress(OSError):
        return set(os.listdir("/proc/self/task"))
    return set()


_LOCK = threading.RLock()  # held when work starts, and while the process forks
_ALL: WeakSet[Background] = WeakSet()
_ENDING: set[str] = set()  # threads of work that is done, and what others made meanwhile
_EXIT = 0.5  # seconds that they get; they need microseconds, on a busy machine milliseconds


def _before_fork() -> None:
    _LOCK.acquire()  # no work starts until the fork is over
    for background in list(_ALL):
        background.join()
    until = time.monotonic() + _EXIT
    while _ENDING & _threads() and time.monotonic() < until:
        time.sleep(1e-4)
    _ENDING.clear()


def _after_fork_in_child() -> None:
    global _LOCK  # threads that do not exist in the child may wait for the parent's lock
    _LOCK = threading.RLock()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(
        before=_before_fork,
        after_in_parent=lambda: _LOCK.release(),
        after_in_child=_after_fork_in_child,
    )
