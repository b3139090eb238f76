"""Fixtures of tests that draw with OpenGL."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import pytest

from fide_tasks import isolated


def _render_elsewhere(environment: dict[str, str]) -> str | None:
    script = "import fide_tasks\nfide_tasks.make('robot', 8).render([[0.5] * 7])"
    return isolated.failure(script, seconds=120, environment=environment)


@pytest.fixture(scope="session")
def render_elsewhere() -> Callable[..., str | None]:
    """Render a frame in a new process; returns the last line of what went wrong."""
    return _render_elsewhere


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip the test where MuJoCo or OpenGL is missing; this process is not touched."""
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo is not installed: pip install mujoco")
    problem = _render_elsewhere({})
    if problem is not None:
        pytest.skip(problem)
