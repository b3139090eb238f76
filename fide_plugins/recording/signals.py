"""Ctrl-C and SIGTERM: rendering stops at once, a step of the optimizer at its end.

A second signal does not wait.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """A signal stopped the run, which has saved its state.

    signum: the signal; by the shell's convention the exit code is 128 + signum.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum


class Interrupts:
    """Turns SIGINT and SIGTERM into `Interrupted` where the state is consistent.

    once: whether it is raised once, and signals that follow are only noted, see `block`.
    Only Python's main thread receives signals; in other threads this does nothing.
    """

    def __init__(self, *, once: bool = False) -> None:
        self._signum: int | None = None
        self._at_once = self._blocked = False
        self._once = once

    def __enter__(self) -> Interrupts:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._before[signum] = signal.signal(signum, self._receive)
        return self

    def __exit__(self, *exception: object) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, handler if handler is not None else signal.SIG_DFL)

    def check(self) -> None:
        """Raise `Interrupted` if a signal has arrived."""
        if self._signum is not None:
            self._blocked = self._once
            raise Interrupted(self._signum)

    def block(self) -> None:
        """From now on only note signals: what was computed is about to be written."""
        self._blocked = True

    @contextmanager
    def unblocked(self) -> Iterator[None]:
        """Within this block, where nothing is written, a second signal raises `Interrupted`."""
        before, self._blocked = self._blocked, False
        try:
            yield
        finally:
            self._blocked = before

    @contextmanager
    def stoppable(self) -> Iterator[None]:
        """Within this block a signal raises `Interrupted` at once."""
        self._at_once = True
        try:
            self.check()
            yield
        finally:
            self._at_once = False

    def _receive(self, signum: int, frame: FrameType | None) -> None:
        again, self._signum = self._signum is not None, signum
        if not self._blocked and (self._at_once or again):
            self.check()
