"""How many threads compute.

Most of what FIDE computes is small: products of matrices with a few hundred rows, images of 112 x
112 pixels.  Several threads do it more slowly than one: they wait for each other by spinning, and
OpenMP's (PyTorch) and OpenBLAS's (NumPy, SciPy) spin on the same cores.  So the small parts compute
in one thread: within `one_thread`.  Networks, and functions of the user's that FIDE calls, compute
in as many threads as the user has set, or the libraries by default: within `user_threads`.  Both
are context managers and decorators, and may be nested.

Therefore a run without a network is the same, bit for bit, whatever number of threads is set.

OpenMP and MKL have one setting for each thread, so other threads keep theirs.  OpenBLAS has one for
the process: the first thread that enters limits it, the last one that leaves restores it, and what
the user's other threads compute with NumPy in between is computed in one thread, too.

A forked process has none of its parent's OpenMP threads, and its first parallel loop would wait
for them for ever.  There `user_threads` is one thread, too.  What else the user's child computes
keeps its setting: importing FIDE changes nothing in it.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable
from contextlib import ContextDecorator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["one_thread", "user_threads"]

_LIBRARIES = ("numpy", "scipy.linalg", "torch")
"""Modules that load libraries with threads of their own, each at another time or never."""
_AFFIXES = tuple(product(("", "scipy_"), ("", "64_", "_64")))
"""What distributions of OpenBLAS put before and after the names of its functions."""


class _Pool(NamedTuple):
    """The threads of one library."""

    limit: Callable[[], int]
    """Compute in one thread from now on; returns what `restore` needs."""
    restore: Callable[[int], object]


class _Pools(NamedTuple):
    """Those of all libraries that are loaded."""

    loaded: tuple[bool, ...] = ()
    """Which of `_LIBRARIES` were, when they were looked for."""
    by_thread: tuple[_Pool, ...] = ()
    by_process: tuple[_Pool, ...] = ()


class _Here(threading.local):
    """State of the calling thread."""

    depth = 0  # how many blocks of `one_thread` it is in
    before: tuple[tuple[_Pool, int], ...] = ()
    outer: tuple[int, ...] = ()  # depths that it had when it entered blocks of `user_threads`


class _Process:
    """State that all threads share."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.pools = _Pools()
        self.inside = 0  # threads that compute in one thread
        self.before: tuple[tuple[_Pool, int], ...] = ()
        self.forked = False


_HERE, _PROCESS = _Here(), _Process()


class _OneThread(ContextDecorator):
    """Within it the calling thread computes alone.  Entering and leaving take some microseconds."""

    def __enter__(self) -> None:
        if _HERE.depth == 0:
            _limit()
        _HERE.depth += 1

    def __exit__(self, *exception: object) -> None:
        _HERE.depth -= 1
        if _HERE.depth == 0:
            _restore()


class _UserThreads(ContextDecorator):
    """Within it the calling thread has what it has outside all blocks of `one_thread`."""

    def __enter__(self) -> None:
        if _PROCESS.forked:
            _HERE.outer += (-1,)
            one_thread.__enter__()
            return
        _HERE.outer += (_HERE.depth,)
        if _HERE.depth:
            _restore()
        _HERE.depth = 0

    def __exit__(self, *exception: object) -> None:
        *outer, depth = _HERE.outer
        _HERE.outer = tuple(outer)
        if depth < 0:
            one_thread.__exit__()
            return
        if depth:
            _limit()
        _HERE.depth = depth


one_thread = _OneThread()
user_threads = _UserThreads()


def _limit() -> None:
    pools = _pools()
    _HERE.before = tuple((pool, pool.limit()) for pool in pools.by_thread)
    with _PROCESS.lock:
        if _PROCESS.inside == 0:
            _PROCESS.before = tuple((pool, pool.limit()) for pool in pools.by_process)
        _PROCESS.inside += 1


def _restore() -> None:
    for pool, before in _HERE.before:
        pool.restore(before)
    _HERE.before = ()
    with _PROCESS.lock:
        _PROCESS.inside -= 1
        if _PROCESS.inside == 0:
            _restore_process()


def _restore_process() -> None:
    for pool, before in _PROCESS.before:
        pool.restore(before)
    _PROCESS.before = ()


# -- the libraries ---------------------------------------------------------------------------------


def _pools() -> _Pools:
    """Look for them (which takes milliseconds) only when another library was imported."""
    loaded = tuple(name in sys.modules for name in _LIBRARIES)
    if loaded != _PROCESS.pools.loaded:
        _PROCESS.pools = _find(loaded)
    if loaded[-1]:
        sys.modules["torch"].get_num_threads()  # a thread's first question sets OpenMP's number
    return _PROCESS.pools


def _find(loaded: tuple[bool, ...]) -> _Pools:
    from threadpoolctl import ThreadpoolController

    by_thread, by_process = list(_mkl_of_torch()), []
    for library in ThreadpoolController().lib_controllers:
        functions, kind = library.dynlib, library.internal_api
        if kind == "openmp":
            number = functions.omp_get_max_threads, functions.omp_set_num_threads
            by_thread.append(_numbered(*number))
        elif kind == "mkl":
            by_thread.append(_mkl(functions))
        elif kind == "openblas":
            by_process += _openblas(library)
        else:
            by_process.append(_numbered(library.get_num_threads, library.set_num_threads))
    return _Pools(loaded, tuple(by_thread), tuple(by_process))


def _numbered(get: Callable[[], int], put: Callable[[int], object]) -> _Pool:
    """A library whose number of threads can be asked and set."""

    def limit() -> int:
        before = get()
        if before != 1:
            put(1)
        return before

    def restore(before: int) -> None:
        if before != 1:
            put(before)

    return _Pool(limit, restore)


def _mkl(functions: Any) -> _Pool:
    """MKL, whose setting for a thread is 0 while that for the process holds."""
    put = functions.MKL_Set_Num_Threads_Local  # returns the last one
    return _Pool(partial(put, 1), put)


def _mkl_of_torch() -> list[_Pool]:
    """The MKL within PyTorch, which threadpoolctl does not know of; it does not follow OpenMP."""
    torch = sys.modules.get("torch")
    for path in [] if torch is None else Path(torch.__path__[0], "lib").glob("libtorch_cpu.*"):
        try:
            return [_mkl(ctypes.CDLL(str(path)))]
        except (OSError, AttributeError):  # another build, without MKL
            continue
    return []


def _openblas(library: Any) -> list[_Pool]:
    """OpenBLAS, by its own functions: through threadpoolctl, only one thread could set them.

    With OpenMP's threads it follows OpenMP.  OpenCV's copy is left alone: FIDE has no use for it.
    """
    if library.threading_layer == "openmp" or "opencv" in library.filepath:
        return []
    for before, after in _AFFIXES:
        names = (f"{before}openblas_{verb}_num_threads{after}" for verb in ("get", "set"))
        get, put = (getattr(library.dynlib, name, None) for name in names)
        if get is not None and put is not None:
            return [_numbered(get, put)]
    return []


# -- forks -----------------------------------------------------------------------------------------


def _after_fork_in_child() -> None:
    """Threads that were inside are not here; the one that forked may be."""
    _PROCESS.lock, _PROCESS.forked = threading.Lock(), True
    _PROCESS.inside = min(_HERE.depth, 1)
    if not _PROCESS.inside:
        _restore_process()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork_in_child)
