"""The target that a task has rendered, kept to the last bit for who goes on with it.

Another process may render other bits: with noise, on a GPU, on another processor.  All runs of a
comparison need the same target, and so does a run that goes on; a second render saves nothing.  The
target that was given as a picture is not kept: it is read again, so that another one is noticed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_target

__all__ = ["NAME", "RenderedTarget"]

NAME = "target.ckpt"
_KIND = "target"


class RenderedTarget(NamedTuple):
    """A file that holds a rendered target, or will hold it.

    path: of the file.
    made_from: what the target is rendered from, its parameters and the source, as text.
    """

    path: Path
    made_from: str

    def read(self) -> Float32 | None:
        """The image (H, W, 3); None if there is none yet, or one that was made from another thing.

        Raises OSError, or CheckpointError (a ValueError) if the file is damaged.
        """
        if not self.path.exists():
            return None
        state = checkpoint.read(self.path, _KIND)
        try:
            if state["made_from"] != self.made_from:
                return None
            return as_target(np.asarray(state["image"], np.float32))
        except IMPOSSIBLE as error:
            raise CheckpointError(
                f"{self.path}: impossible contents ({error}); start again in another directory"
            ) from error

    def write(self, image: Float32) -> None:
        """Write the image (H, W, 3), atomically, unless `read` gives one.

        Raises what `read` raises, and OSError.
        """
        if self.read() is None:
            checkpoint.write(self.path, _KIND, {"made_from": self.made_from, "image": image})
