"""Fixtures of tests that draw with OpenGL."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable

import pytest


def _render_elsewhere(environment: dict[str, str], before: str = "") -> str | None:
    script = (
        f"import sys; sys.path[:0] = {[p for p in sys.path if p]}\n{before}\n"
        "import fide_tasks\nfide_tasks.make('robot', 8).render([[0.5] * 7])"
    )
    run = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    return None if run.returncode == 0 else run.stderr.strip().splitlines()[-1]


@pytest.fixture(scope="session")
def render_elsewhere() -> Callable[..., str | None]:
    """Render a frame in a new process; returns the last line of what went wrong."""
    return _render_elsewhere


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip the test where MuJoCo or OpenGL is missing; this process is not touched."""
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo is not installed: pip install 'fide-plugins[robot]'")
    problem = _render_elsewhere({})
    if problem is not None:
        pytest.skip(problem)
