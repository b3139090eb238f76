"""Ctrl-C and SIGTERM: stop where the state is whole, save, and say so.

While a frame is rendered the signal stops it at once, since an unfinished piece is simply rendered
again after resuming.  Inside the optimizer it waits for the step to end.  A second signal does not
wait.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

__all__ = ["Interrupted", "Interrupts"]


class Interrupted(KeyboardInterrupt):
    """The run was stopped by a signal and has saved its state.

    signum: the signal; the shell's convention for the exit code is 128 + signum.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum


class Interrupts:
    """Turns SIGINT and SIGTERM into `Interrupted` at the right moment.

    Only Python's main thread can take signals; elsewhere this does nothing.
    """

    def __init__(self) -> None:
        self._signum: int | None = None
        self._at_once = False

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
        """Raise `Interrupted` if a signal has come."""
        if self._signum is not None:
            raise Interrupted(self._signum)

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
        if self._at_once or again:
            raise Interrupted(signum)
