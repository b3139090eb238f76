"""The whole state of an optimizer as bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fide_plugins.fide import FIDE


@pytest.fixture
def state_of(tmp_path: Path) -> Callable[[FIDE], bytes]:
    """All that a checkpoint holds, but for the times."""

    def state_of(opt: FIDE) -> bytes:
        times, path = opt.times, tmp_path / "state"
        opt.state.times = dict.fromkeys(times, 0.0)
        opt.save(path)
        opt.state.times = times
        return path.read_bytes()

    return state_of
