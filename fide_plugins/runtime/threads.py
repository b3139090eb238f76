"""Threads: how many compute, locks, and what a fork leaves of them.

The small parts compute in one thread, within `one_thread`; networks, and functions of the user's,
in as many as the user has set, within `user_threads`.  OpenMP and MKL have one setting for each
thread.  OpenBLAS has one for the process: the first thread that enters limits it, the last one that
leaves restores.  In a forked process `user_threads` is one thread, and a `Lock` is free.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable
from contextlib import ContextDecorator, suppress
from functools import partial, wraps
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast
from weakref import WeakSet

_LIBRARIES = ("numpy", "scipy.linalg", "torch")  # whose threads are limited, where they are loaded
_AFFIXES = tuple(product(("", "scipy_"), ("", "64_", "_64")))  # of OpenBLAS's functions


class _Pool(NamedTuple):
    """The threads of one library."""

    limit: Callable[[], int]  # compute in one thread; returns what `restore` needs
    restore: Callable[[int], object]


_Limited = tuple[tuple[_Pool, int], ...]


class _Thread(threading.local):
    """State of the calling thread."""

    depth = 0  # how many blocks of `one_thread` it is in
    before: _Limited = ()
    outer: tuple[int, ...] = ()  # depths that it had when it entered blocks of `user_threads`


class _Process:
    """State that all threads share: the libraries that are loaded, and their threads."""

    lock = threading.Lock()
    loaded: tuple[bool, ...] = ()
    by_thread: tuple[_Pool, ...] = ()
    by_process: tuple[_Pool, ...] = ()
    inside = 0  # threads that compute in one thread
    before: _Limited = ()
    forked = False


_THREAD, _PROCESS = _Thread(), _Process()


class _OneThread(ContextDecorator):
    """Within it the calling thread computes alone.  Entering and leaving take some microseconds."""

    def __enter__(self) -> None:
        if _THREAD.depth == 0:
            _limit()
        _THREAD.depth += 1

    def __exit__(self, *exception: object) -> None:
        _THREAD.depth -= 1
        if _THREAD.depth == 0:
            _restore()


class _UserThreads(ContextDecorator):
    """Within it the calling thread has what it has outside all blocks of `one_thread`."""

    def __enter__(self) -> None:
        _THREAD.outer += (-1 if _PROCESS.forked else _THREAD.depth,)
        if _PROCESS.forked:
            one_thread.__enter__()
            return
        if _THREAD.depth:
            _restore()
        _THREAD.depth = 0

    def __exit__(self, *exception: object) -> None:
        *outer, depth = _THREAD.outer
        _THREAD.outer = tuple(outer)
        if depth < 0:
            one_thread.__exit__()
            return
        if depth:
            _limit()
        _THREAD.depth = depth


one_thread = _OneThread()
user_threads = _UserThreads()


def _limit() -> None:
    loaded = tuple(name in sys.modules for name in _LIBRARIES)
    if loaded != _PROCESS.loaded:  # to look for them takes milliseconds
        _find(loaded)
    if loaded[-1]:
        sys.modules["torch"].get_num_threads()  # a thread's first question sets OpenMP's number
    _THREAD.before = tuple((pool, pool.limit()) for pool in _PROCESS.by_thread)
    with _PROCESS.lock:
        if _PROCESS.inside == 0:
            _PROCESS.before = tuple((pool, pool.limit()) for pool in _PROCESS.by_process)
        _PROCESS.inside += 1


def _restore() -> None:
    _put_back(_THREAD)
    with _PROCESS.lock:
        _PROCESS.inside -= 1
        if _PROCESS.inside == 0:
            _put_back(_PROCESS)


def _put_back(state: _Thread | _Process) -> None:
    for pool, before in state.before:
        pool.restore(before)
    state.before = ()


# -- the libraries ---------------------------------------------------------------------------------


def _find(loaded: tuple[bool, ...]) -> None:
    from threadpoolctl import ThreadpoolController

    by_thread, by_process = _mkl_of_torch(), []
    for library in ThreadpoolController().lib_controllers:
        functions, kind = library.dynlib, library.internal_api
        if kind == "openmp":
            pool = _numbered(functions.omp_get_max_threads, functions.omp_set_num_threads)
            by_thread.append(pool)
        elif kind == "mkl":
            by_thread.append(_mkl(functions))
        elif kind == "openblas":
            by_process += _openblas(library)
        else:
            by_process.append(_numbered(library.get_num_threads, library.set_num_threads))
    _PROCESS.by_thread, _PROCESS.by_process = tuple(by_thread), tuple(by_process)
    _PROCESS.loaded = loaded


def _numbered(get: Callable[[], int], put: Callable[[int], object]) -> _Pool:
    """A library whose number of threads can be asked and set."""

    def limit() -> int:
        before = get()
        if before != 1:
            put(1)
        return before

    return _Pool(limit, lambda before: before != 1 and put(before))


def _mkl(functions: Any) -> _Pool:
    """MKL, whose setting for a thread is 0 while that for the process holds."""
    put = functions.MKL_Set_Num_Threads_Local  # returns the last one
    return _Pool(partial(put, 1), put)


def _mkl_of_torch() -> list[_Pool]:
    """The MKL within PyTorch, which threadpoolctl does not know of; it does not follow OpenMP."""
    torch = sys.modules.get("torch")
    for path in [] if torch is None else Path(torch.__path__[0], "lib").glob("libtorch_cpu.*"):
        with suppress(OSError, AttributeError):  # another build, without MKL
            return [_mkl(ctypes.CDLL(str(path)))]
    return []


def _openblas(library: Any) -> list[_Pool]:
    """OpenBLAS, by its own functions: through threadpoolctl, only one thread could set them."""
    if library.threading_layer == "openmp" or "opencv" in library.filepath:
        return []
    for before, after in _AFFIXES:
        names = (f"{before}openblas_{verb}_num_threads{after}" for verb in ("get", "set"))
        get, put = (getattr(library.dynlib, name, None) for name in names)
        if get is not None and put is not None:
            return [_numbered(get, put)]
    return []


# -- locks -----------------------------------------------------------------------------------------

F = TypeVar("F", bound=Callable[..., Any])


class Lock:
    """A reentrant lock for ``with``; a copy of it, or the lock in a forked process, is free."""

    def __init__(self) -> None:
        self.renew()
        _LOCKS.add(self)

    def renew(self) -> None:
        """Free the lock, whoever holds it."""
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *exception: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[Lock], tuple[()]]:
        return Lock, ()


_LOCKS: WeakSet[Lock] = WeakSet()


def one_at_a_time(method: F) -> F:
    """Decorate a method: one thread at a time runs those of an object, by its `Lock` `_lock`."""

    @wraps(method)
    def locked(self: Any, /, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return cast(F, locked)


# -- forks -----------------------------------------------------------------------------------------


def _after_fork_in_child() -> None:
    for lock in _LOCKS:
        lock.renew()
    _PROCESS.lock, _PROCESS.forked = threading.Lock(), True
    _PROCESS.inside = min(_THREAD.depth, 1)  # of threads that were inside, only this one is left
    if not _PROCESS.inside:
        _put_back(_PROCESS)


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork_in_child)
