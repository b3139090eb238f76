"""Which distributions of OpenCV are installed, without importing it."""

from __future__ import annotations

import importlib.metadata

__all__ = ["OURS", "collision", "installed", "remedy"]

OURS = "opencv-contrib-python-headless"
"""The one that FIDE requires: it needs no libGL, and has all modules of the others."""
_ALL = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", OURS)


def installed() -> list[str]:
    """Names of the distributions that are installed."""
    found = []
    for name in _ALL:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        found.append(name)
    return found


def remedy() -> str:
    """Commands that install one OpenCV, and no other."""
    there = installed()
    uninstall = f"pip uninstall -y {' '.join(there)} && " if there else ""
    return f"{uninstall}pip install {OURS}"


def collision() -> str | None:
    """What is wrong, and what to do, where several are installed; None where it is one or none."""
    there = installed()
    if len(there) < 2:
        return None
    return f"{' and '.join(there)} overwrite each other's files; keep one: {remedy()}"
