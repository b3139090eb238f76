"""Runs code that may crash (drivers and compilers of the machine) in a separate process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping


def failure(
    script: str, *arguments: str, seconds: float, environment: Mapping[str, str] | None = None
) -> str | None:
    """Run a Python script; returns the reason of its failure in one line, or None on success.

    The script runs in an empty folder: Python and Mitsuba load code from the current folder, which
    may contain an untrusted scene.
    """
    paths = os.pathsep.join(map(os.path.abspath, sys.path))  # same import path as this process
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
