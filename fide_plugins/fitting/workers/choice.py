"""Which workers `fit` takes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from multiprocessing import current_process
from typing import Any, TypeAlias

from fide_plugins.errors import OptionError
from fide_plugins.fitting.rendering import Outcome
from fide_plugins.fitting.workers.base import Workers
from fide_plugins.fitting.workers.executors import OfExecutor
from fide_plugins.fitting.workers.here import Here
from fide_plugins.fitting.workers.processes import Processes
from fide_plugins.fitting.workers.threads import DaemonThreads
from fide_plugins.runtime.machine import cores
from fide_plugins.runtime.messages import warn_user

__all__ = ["DAEMON", "default_number", "workers_for"]

_Renderer: TypeAlias = Callable[[Any], Outcome]

DAEMON = "a daemonic process, such as those of multiprocessing.Pool, cannot start others"
"""Why no process is started in such a process."""
_MOST = 8  # workers by default: more need more renders for the same loss
_REMEDY = "give executor='threads', or workers=0"


def default_number(executor: object = None) -> int:
    """How many renders run at a time where the user does not say: one a usable core, at most 8.

    An executor renders elsewhere, and threads are for renders that wait: 8 of these.
    """
    return min(cores(), _MOST) if executor in (None, "processes") else _MOST


def workers_for(
    renderer: _Renderer, number: int, executor: object, timeout: float | None
) -> Workers:
    """Workers for a renderer; nothing is started yet.

    renderer: an outcome for a point x (d,), or for whatever is submitted.
    number: of renders at a time; 0: in this process.
    executor: None or "processes", "threads", an executor of `concurrent.futures`, or what has a
        method `get_executor`, as Dask's Client.
    timeout: of a render, which this process does not have.

    Raises OptionError (a ValueError).
    """
    if number == 0:
        if executor is not None:
            raise OptionError("workers=0 renders in this process: leave out executor")
        if timeout is not None:
            raise OptionError("timeout needs a worker that can be killed: give workers >= 1")
        return Here(renderer)
    if executor is None:
        return _processes_or_threads(renderer, number)
    if executor == "processes":
        return _processes(renderer, number)
    if executor == "threads":
        return _threads(renderer, number)
    return OfExecutor(_as_executor(executor), renderer, number, own=False)


def _processes_or_threads(renderer: _Renderer, number: int) -> Workers:
    if current_process().daemon:
        warn_user(f"{DAEMON}, so render runs in threads of this one; to silence this, {_REMEDY}")
        return _threads(renderer, number)
    try:
        return Processes(renderer, number)
    except Exception as error:  # whatever the user's objects raise when they are pickled
        warn_user(
            f"render cannot be sent to other processes ({type(error).__name__}: {error}), so it "
            "runs in threads of this one; to silence this, give executor='threads', or make what "
            "it needs inside of it"
        )
        return _threads(renderer, number)


def _processes(renderer: _Renderer, number: int) -> Workers:
    if current_process().daemon:
        raise OptionError(f"{DAEMON}; {_REMEDY}")
    try:
        return Processes(renderer, number)
    except Exception as error:
        raise OptionError(
            f"render cannot be sent to other processes ({type(error).__name__}: {error}); make "
            "what it needs inside of it, or give executor='threads'"
        ) from error


def _threads(renderer: _Renderer, number: int) -> Workers:
    return OfExecutor(DaemonThreads(number), renderer, number, own=True)


def _as_executor(executor: object) -> Executor:
    if hasattr(executor, "get_executor"):  # Dask's Client; the same point may be rendered twice
        made: Executor = executor.get_executor(pure=False)
        return made
    if isinstance(executor, Executor) or hasattr(executor, "submit"):
        return executor  # type: ignore[return-value]
    raise OptionError(
        "executor must be 'processes', 'threads', an executor of concurrent.futures or Dask's "
        f"Client, not {executor!r}"
    )
