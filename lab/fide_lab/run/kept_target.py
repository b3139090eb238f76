"""The target of a run, kept to the last bit: noise, or a GPU, would make another one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE, check, maybe, text
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_target

_TARGET = "target"
_MEAN, _LARGEST = 1e-5, 1.01 / 255  # rounding by 1e-7 moves a few values of 8 bits by a step


class KeptTarget(NamedTuple):
    """A target (H, W, 3) to the last bit, and by what it is known without another render."""

    image: Float32
    source: str | None


def read_target(path: Path) -> KeptTarget | None:
    """The target in a file; None if the file is not there, or in a folder that may not be read."""
    if not os.path.exists(path):
        return None
    state = checkpoint.read(path, _TARGET)
    try:
        check({"source": state["source"]}, {"source": maybe(text)}, {})
        return KeptTarget(as_target(np.asarray(state["image"], np.float32)), state["source"])
    except IMPOSSIBLE as error:
        why = f"impossible contents ({error}); start again in another directory"
        raise CheckpointError(f"{path}: {why}") from error


def write_target(path: Path, target: KeptTarget) -> None:
    """Write the target to a file, atomically.  Raises OSError."""
    checkpoint.write(path, _TARGET, target._asdict())


def same_target(one: Float32, other: Float32) -> bool:
    """Whether two images differ by rounding at most."""
    if one.shape != other.shape:
        return False
    off = np.abs(one - other)
    return float(off.max()) <= _LARGEST and float(off.mean()) <= _MEAN
