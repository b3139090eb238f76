"""Images of candidates in a run directory: ``solutions.ckpt``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE, Schema, array, check
from fide_plugins.types import Float32, Float64

__all__ = ["of", "read", "write"]

_KIND, _NAME = "solutions", "solutions.ckpt"
_SCHEMA: Schema = {
    "x": array("n", "d", low=0.0, high=1.0),
    "images": array("n", "H", "W", 3, low=0.0, high=1.0),
}

Known = list[tuple[Float64, Float32]]
"""Points (d,) and their images (H, W, 3)."""


def write(directory: Path, points: Sequence[Float64], images: Sequence[Float32]) -> None:
    """Write images (H, W, 3) of points (d,); n >= 1.  Raises OSError."""
    state = {"x": np.array(points), "images": np.array(images)}
    checkpoint.write(directory / _NAME, _KIND, state)


def read(directory: Path) -> Known:
    """What was written; nothing if nothing was.  Raises CheckpointError if it is damaged."""
    path = directory / _NAME
    if not path.exists():
        return []
    state: Any = checkpoint.read(path, _KIND)
    try:
        check(state, _SCHEMA, {}, "solutions")
    except IMPOSSIBLE as error:
        raise CheckpointError(f"{path}: impossible contents ({error}); remove it") from error
    return list(zip(state["x"], state["images"], strict=True))


def of(known: Known, x: Float64) -> Float32 | None:
    """The image of the point x (d,); None if there is none."""
    return next((image for point, image in known if np.array_equal(point, x)), None)
