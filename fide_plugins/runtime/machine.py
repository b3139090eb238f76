"""Versions and hardware, found without importing large packages."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

__all__ = ["cores", "cpu_name", "load", "machine", "version_of", "versions"]

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
    "botorch",
    "gpytorch",
    "sbi",
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
