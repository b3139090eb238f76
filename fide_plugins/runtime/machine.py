"""Versions and hardware, found without importing large packages."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

__all__ = ["cores", "cpu_name", "load", "machine", "version_of", "versions"]

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


def cores() -> int:
    """Cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
