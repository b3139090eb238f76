"""A process of its own for what may crash: drivers and compilers that are found on the machine."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping

__all__ = ["failure"]


def failure(
    script: str, *arguments: str, seconds: float, environment: Mapping[str, str] | None = None
) -> str | None:
    """Run a script of Python; returns what went wrong, in one line, or None if nothing did.

    It runs in an empty folder, since Python and Mitsuba look for code in the one that they are
    started in, which may be that of a scene from elsewhere.
    """
    paths = os.pathsep.join(map(os.path.abspath, sys.path))  # it imports what this process does
    try:
        with tempfile.TemporaryDirectory() as empty:
            run = subprocess.run(
                [sys.executable, "-c", script, *arguments],
                env={**os.environ, "PYTHONPATH": paths, **(environment or {})},
                cwd=empty,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=seconds,
            )
    except subprocess.TimeoutExpired:
        return f"it rendered nothing within {seconds:.0f} s"
    if run.returncode == 0:
        return None
    if run.returncode < 0:
        return f"it aborts the process (signal {-run.returncode})"
    lines = run.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit code {run.returncode}"
