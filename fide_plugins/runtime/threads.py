"""What is around a computation: how many threads take part, who waits, how long it takes.

Small parts compute within `one_thread`, networks and the user's functions within `user_threads`.
OpenBLAS has one setting for the process: the last thread that leaves restores it.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, MutableMapping
from contextlib import ContextDecorator, contextmanager, suppress
from functools import wraps
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast
from weakref import WeakSet

_LIBRARIES = ("numpy", "scipy.linalg", "torch")  # whose threads are limited, where they are loaded
_AFFIXES = tuple(product(("", "scipy_"), ("", "64_", "_64")))  # of OpenBLAS's functions


_Put: TypeAlias = Callable[[int], Any]
_Pool: TypeAlias = tuple[Callable[[], int] | None, _Put]
"""The threads of one library: what tells their number, and what sets it.

None in place of the former: the latter returns the number before.
"""


class _Thread(threading.local):
    """State of the calling thread."""

    depth = 0  # how many blocks of `one_thread` it is in
    before: tuple[tuple[_Put, int], ...] = ()  # numbers to be restored
    outer: tuple[int, ...] = ()  # depths that it had when it entered blocks of `user_threads`


class _Process:
    """State that all threads share: the libraries that are loaded, and their threads."""

    lock = threading.Lock()
    loaded: tuple[bool, ...] = ()
    by_thread: tuple[_Pool, ...] = ()
    by_process: tuple[_Pool, ...] = ()
    inside = 0  # threads that compute in one thread
    before: tuple[tuple[_Put, int], ...] = ()  # numbers to be restored
    forked = False


_THREAD, _PROCESS = _Thread(), _Process()


class _OneThread(ContextDecorator):
    """Within it the calling thread computes alone.  Entering and leaving take some microseconds."""

    def __enter__(self) -> None:
        if _THREAD.depth == 0:
            loaded = tuple(name in sys.modules for name in _LIBRARIES)
            if loaded != _PROCESS.loaded:  # to look for them takes milliseconds
                _find(loaded)
            if loaded[-1]:
                sys.modules["torch"].get_num_threads()  # a thread's first question sets OpenMP's
            _THREAD.before = _limited(_PROCESS.by_thread)
            with _PROCESS.lock:
                if _PROCESS.inside == 0:
                    _PROCESS.before = _limited(_PROCESS.by_process)
                _PROCESS.inside += 1
        _THREAD.depth += 1

    def __exit__(self, *exception: object) -> None:
        _THREAD.depth -= 1
        if _THREAD.depth == 0:
            with _PROCESS.lock:
                _PROCESS.inside -= 1
                for state in (_THREAD,) if _PROCESS.inside else (_THREAD, _PROCESS):
                    for put, before in state.before:
                        put(before)
                    state.before = ()


class _UserThreads(ContextDecorator):
    """Within it the calling thread has what it has outside all blocks of `one_thread`."""

    def __enter__(self) -> None:
        depth = -1 if _PROCESS.forked else _THREAD.depth
        _THREAD.outer += (depth,)
        if depth < 0:
            one_thread.__enter__()
        elif depth:
            _THREAD.depth = 1
            one_thread.__exit__()

    def __exit__(self, *exception: object) -> None:
        *outer, depth = _THREAD.outer
        _THREAD.outer = tuple(outer)
        if depth < 0:
            one_thread.__exit__()
        elif depth:
            one_thread.__enter__()
            _THREAD.depth = depth


one_thread = _OneThread()
user_threads = _UserThreads()


def _limited(pools: Iterable[_Pool]) -> tuple[tuple[_Put, int], ...]:
    """Limit these to one thread; returns what restores those that had another number."""
    changed = []
    for get, put in pools:
        before = put(1) if get is None else get()
        if before != 1:
            put(1)
            changed.append((put, before))
    return tuple(changed)


def _find(loaded: tuple[bool, ...]) -> None:
    """Find the libraries.

    MKL's setting for a thread is 0 while that for the process holds.  threadpoolctl does not know
    the MKL within PyTorch, which does not follow OpenMP; and sets OpenBLAS for one thread only.
    """
    from threadpoolctl import ThreadpoolController

    by_thread: list[_Pool] = []
    by_process: list[_Pool] = []
    torch = sys.modules.get("torch")
    for path in [] if torch is None else Path(torch.__path__[0], "lib").glob("libtorch_cpu.*"):
        with suppress(OSError, AttributeError):  # another build, without MKL
            by_thread.append((None, ctypes.CDLL(str(path)).MKL_Set_Num_Threads_Local))
    for library in ThreadpoolController().lib_controllers:
        functions: Any = library.dynlib
        if library.internal_api == "openmp":
            by_thread.append((functions.omp_get_max_threads, functions.omp_set_num_threads))
        elif library.internal_api == "mkl":
            by_thread.append((None, functions.MKL_Set_Num_Threads_Local))
        elif library.internal_api != "openblas":
            by_process.append((library.get_num_threads, library.set_num_threads))
        elif library.threading_layer != "openmp" and "opencv" not in library.filepath:
            for name in (f"{one}openblas_%s_num_threads{other}" for one, other in _AFFIXES):
                get, put = (getattr(functions, name % verb, None) for verb in ("get", "set"))
                if get is not None and put is not None:
                    by_process.append((get, put))
                    break
    _PROCESS.by_thread, _PROCESS.by_process = tuple(by_thread), tuple(by_process)
    _PROCESS.loaded = loaded


# -- locks -----------------------------------------------------------------------------------------

F = TypeVar("F", bound=Callable[..., Any])


class Lock:
    """A reentrant lock, `held`; a copy of it, or the lock in a forked process, is free."""

    def __init__(self) -> None:
        self.held = threading.RLock()
        _LOCKS.add(self)

    def __reduce__(self) -> tuple[type[Lock], tuple[()]]:
        return Lock, ()


_LOCKS: WeakSet[Lock] = WeakSet()


def one_at_a_time(method: F) -> F:
    """Decorate a method: one thread at a time runs those of an object, by its `Lock` `_lock`."""

    @wraps(method)
    def locked(self: Any, /, *args: Any, **kwargs: Any) -> Any:
        with self._lock.held:
            return method(self, *args, **kwargs)

    return cast(F, locked)


# -- time ------------------------------------------------------------------------------------------


@contextmanager
def timed(times: MutableMapping[str, float], part: str) -> Iterator[None]:
    """Add the time of this block to `part`, without the time that it adds to other parts.

    A block that raises adds nothing: an error must not change the state.
    """
    others, start = sum(times.values()), time.perf_counter()
    yield
    elapsed = time.perf_counter() - start
    times[part] += max(0.0, elapsed - (sum(times.values()) - others))


# -- forks -----------------------------------------------------------------------------------------


def _after_fork_in_child() -> None:
    for lock in _LOCKS:
        lock.held = threading.RLock()
    _PROCESS.lock, _PROCESS.forked = threading.Lock(), True
    _PROCESS.inside = min(_THREAD.depth, 1)  # of threads that were inside, only this one is left
    for put, before in () if _PROCESS.inside else _PROCESS.before:
        put(before)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork_in_child)
