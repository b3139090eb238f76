"""How a worker process ended, whoever asked the system first."""

from __future__ import annotations

from typing import Any

from fide_plugins.fitting.workers.processes import _exit_code


class Ending:
    """A process of which another thread has got the code, and notes it a moment later."""

    def __init__(self, code: int | None, after: int) -> None:
        self.code, self.after = code, after

    def join(self, timeout: float) -> None:
        """Return at once: the system has nothing more to say."""

    @property
    def exitcode(self) -> int | None:
        self.after -= 1
        return self.code if self.after < 0 else None


def test_the_exit_code_is_waited_for() -> None:
    process: Any = Ending(7, after=3)
    assert _exit_code(process) == 7


def test_an_exit_code_that_nobody_knows_is_none() -> None:
    process: Any = Ending(None, after=0)
    assert _exit_code(process) is None
