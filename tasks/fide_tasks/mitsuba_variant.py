"""Which of Mitsuba's variants runs on this machine, and with which LLVM library.

Some releases of LLVM abort the whole process at the first kernel (15 does).  So a variant is tried
in a process of its own before this one relies on it.
"""

from __future__ import annotations

import ctypes
import importlib.util
import logging
import os
import re
import site
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from glob import glob
from typing import Any

from fide_tasks import isolated
from fide_tasks.base import one_of

VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}
"""Short names of the variants, in the order of preference, and Mitsuba's names."""

_log = logging.getLogger(__name__)
_LOCK = threading.RLock()  # the variant and the number of threads belong to the whole process
_left: str | None = None  # the variant that `in_variant` left active when it last did
_CHECK_SECONDS = 120.0  # for a first frame, of which about one is needed
_LIBRARY = "DRJIT_LIBLLVM_PATH"  # read when Mitsuba is first imported
_LIBRARY_PLACES = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)
_CHECK = """
import sys, numpy, mitsuba as mi
mi.set_variant(sys.argv[1])
box = mi.cornell_box()
box["bead"] = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric"}}
box["sensor"]["film"] |= {"width": 4, "height": 4, "rfilter": {"type": "box"}}
assert numpy.isfinite(numpy.array(mi.render(mi.load_dict(box), spp=1))).all()
"""
_INSTALL_LLVM = (
    "install a recent LLVM library (19 is tested; on Debian: apt-get install libllvm19), "
    f"or name one in the environment variable {_LIBRARY}"
)
REMEDIES = {
    "cuda": "it needs an NVIDIA GPU and its driver",
    "llvm": _INSTALL_LLVM,
}
"""What to do where a variant, by its short name, does not run; "scalar" runs everywhere."""


def choose(variant: str) -> str:
    """Return Mitsuba's name of the variant to be used; "auto" takes the fastest that runs.

    `variant` is "auto", "cuda", "llvm", "scalar", or one of Mitsuba's three names for them.

    Raises ImportError if Mitsuba is not installed, ValueError if the variant is unknown or does not
    run here; both say what to do.
    """
    names = {**VARIANTS, **{full: full for full in VARIANTS.values()}}
    one_of("variant", variant, ("auto", *names))
    if importlib.util.find_spec("mitsuba") is None:
        from fide_plugins.runtime.machine import missing

        raise missing("mitsuba", "this task renders with Mitsuba 3, which is not installed")
    if variant == "auto":
        return _best()
    (short,) = (s for s, full in VARIANTS.items() if variant in (s, full))
    problem = problem_with(short)
    if problem is not None:
        raise ValueError(
            f"Mitsuba's variant {names[variant]} does not run here ({problem}); "
            f"{REMEDIES[short]}, or choose variant='auto'"
        )
    return names[variant]


@cache
def problem_with(short: str) -> str | None:
    """What keeps the variant "cuda", "llvm" or "scalar" from running here; None if nothing does."""
    if importlib.util.find_spec("mitsuba") is None:
        return "Mitsuba is not installed"
    if short == "scalar":
        return None
    return _problem_with_cuda() if short == "cuda" else _problem_with_llvm()


def library() -> str | None:
    """Return the LLVM library that is used, if Mitsuba was not left to find one itself."""
    return os.environ.get(_LIBRARY)


@contextmanager
def in_variant(variant: str, threads: int | None = None) -> Iterator[Any]:
    """Give Mitsuba with `variant` active, on so many threads, its own plugins first.

    Mitsuba has one active variant and one set of threads for the whole process, so only one thread
    of Python can be in here at a time. Afterwards the number of threads is as before, and so is the
    variant if somebody else had set one. Changing it takes some tens of milliseconds, so it is left
    as it is otherwise.

    Plugins are code. Mitsuba would load them first of all from a folder called plugins in the
    folder in which this process was started, which may be that of a scene from elsewhere. Here it
    looks up files in its own folder first; others are to be named by absolute paths, and plugins
    must be those it has.
    """
    global _left
    with _LOCK:
        _export_library()
        import drjit
        import mitsuba

        mi: Any = mitsuba
        dr: Any = drjit
        before = mi.variant(), dr.thread_count(), mi.file_resolver()
        mi.set_variant(variant)
        try:
            own = mi.FileResolver(before[2])
            own.clear()
            own.append(os.path.dirname(mi.__file__))
            mi.set_file_resolver(own)
            if threads is not None:
                dr.set_thread_count(threads)
            yield mi
        finally:
            if before[0] in (None, variant, _left):
                _left = variant
            else:
                mi.set_variant(before[0])
            dr.set_thread_count(before[1])
            mi.set_file_resolver(before[2])


@cache
def _best() -> str:
    """The fastest variant that runs here, said once."""
    short = next(short for short in VARIANTS if problem_with(short) is None)
    full = VARIANTS[short]
    if short == "scalar":
        _log.warning(
            "Mitsuba renders with %s, several times slower than it could: %s; %s",
            full, problem_with("llvm"), _INSTALL_LLVM,
        )  # fmt: skip
    else:
        llvm = f" and {library() or 'an LLVM library of its own choice'}"
        _log.info("Mitsuba renders with %s%s", full, llvm if short == "llvm" else "")
    return full


def _problem_with_cuda() -> str | None:
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return "there is no NVIDIA driver"
    return _check_variant(VARIANTS["cuda"], None)


def _problem_with_llvm() -> str | None:
    """Try the libraries that are there, newest first, and keep the first that works."""
    given = os.environ.get(_LIBRARY)
    candidates = [given] if given else [*_libraries(), None]  # None: let Mitsuba search
    problems = []
    for path in candidates:
        problem = _check_variant(VARIANTS["llvm"], path)
        if problem is None:
            if path is not None:
                os.environ[_LIBRARY] = path
            return None
        problems.append(f"{path}: {problem}" if path else problem)
    return "; ".join(problems)


def _libraries() -> list[str]:
    """LLVM libraries in the usual places, each once, the newest version first."""
    found = {os.path.realpath(path) for place in _LIBRARY_PLACES for path in glob(place)}
    return sorted(found, key=_version, reverse=True)


def _version(path: str) -> tuple[int, ...]:
    """Version in the name of a library: (19, 1) for libLLVM.so.19.1 and for libLLVM-19.1.so."""
    return tuple(map(int, re.findall(r"\d+", os.path.basename(path))))


def _export_library() -> None:
    """Tell Mitsuba, before it is first imported, of the newest library there is, if of none yet."""
    if "drjit" not in sys.modules and _LIBRARY not in os.environ:
        for newest in _libraries()[:1]:
            os.environ[_LIBRARY] = newest


def _check_variant(variant: str, llvm: str | None) -> str | None:
    """Render in a process of its own; returns what went wrong."""
    with tempfile.TemporaryDirectory() as home:
        environment = {"HOME": home, "TMP": home, "TEMP": home}
        environment["PYTHONUSERBASE"] = site.getuserbase()  # where packages of this user lie
        if llvm is not None:  # the check runs in another folder
            environment[_LIBRARY] = os.path.abspath(llvm) if os.sep in llvm else llvm
        return isolated.failure(_CHECK, variant, seconds=_CHECK_SECONDS, environment=environment)
