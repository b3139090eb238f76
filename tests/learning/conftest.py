"""A small renderer, and a model that has learned it in two seconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.learning import Model, learn
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64

SIDE = 16
_GRID = (np.arange(SIDE) + 0.5) / SIDE


def disk(params: dict[str, Any]) -> Float64:
    """Soft disk of a gray at (x, y); `hidden` has no effect."""
    distance = np.hypot(_GRID[None] - params["x"], _GRID[:, None] - params["y"])
    disk: Float64 = (0.2 + 0.8 * params["gray"]) / (1 + np.exp((distance - 0.25) * 15))
    return disk


SPACE = Space(x=Float(0, 1), y=Float(0, 1), gray=Float(0, 1), hidden=Float(0, 1))


@pytest.fixture(scope="session")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of a model of the disk; the renders are beside it."""
    path = tmp_path_factory.mktemp("learned") / "disk.fide"
    learn(disk, SPACE, renders=1200, size=SIDE, passes=6, out=path)
    return path


@pytest.fixture(scope="session")
def model(learned: Path) -> Model:
    return Model.load(learned)
