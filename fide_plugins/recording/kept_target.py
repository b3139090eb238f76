"""The target of a run, or of all runs of a comparison, kept to the last bit.

Another process may render another one: with noise, on a GPU or another processor.  All runs of a
comparison need the same target, and so does a run that goes on.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_target

__all__ = ["NAME", "KeptTarget", "agree", "read", "write"]

NAME = "target.ckpt"
_KIND = "target"
_MEAN, _LARGEST = 1e-5, 1.01 / 255  # rounding by 1e-7 moves a few values of 8 bits by a step


class KeptTarget(NamedTuple):
    """What such a file holds.

    image: (H, W, 3).
    source: by what the same target is known without another render; None where nothing tells.
    """

    image: Float32
    source: str | None


def read(path: Path) -> KeptTarget | None:
    """The target in a file; None if the file is not there, or in a folder that may not be read.

    Raises OSError, or CheckpointError (a ValueError) if the file is damaged.
    """
    if not os.path.exists(path):
        return None
    state = checkpoint.read(path, _KIND)
    try:
        image, source = as_target(np.asarray(state["image"], np.float32)), state["source"]
        if not isinstance(source, str | None):
            raise TypeError("its source is no text")
    except IMPOSSIBLE as error:
        raise CheckpointError(
            f"{path}: impossible contents ({error}); start again in another directory"
        ) from error
    return KeptTarget(image, source)


def write(path: Path, target: KeptTarget) -> None:
    """Write the target to a file, atomically.  Raises OSError."""
    checkpoint.write(path, _KIND, target._asdict())


def agree(one: Float32, other: Float32) -> bool:
    """Whether two images differ by rounding at most."""
    if one.shape != other.shape:
        return False
    off = np.abs(one - other)
    return float(off.max()) <= _LARGEST and float(off.mean()) <= _MEAN
