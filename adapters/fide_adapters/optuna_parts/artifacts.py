"""Images of trials in an artifact store, for people to see and other processes to learn from.

Optuna writes down that there is an artifact before the artifact is there, and a store may have lost
it: whatever goes wrong in reading, the trial counts without its image.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from optuna.artifacts import get_all_artifact_meta, upload_artifact
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, Trial
from PIL import Image

from fide_adapters.optuna_parts.voice import Voice
from fide_plugins.images import Float32, as_batch

__all__ = ["ImageArtifacts"]

_PREFIX = "artifacts:"  # of Optuna's attributes
_MOST_BYTES = 2**28
_SIGN_OF_ERROR = (
    OSError, ValueError, ArithmeticError, RuntimeError, LookupError, SyntaxError, TypeError
)  # fmt: skip


class ImageArtifacts:
    """The images in one artifact store.

    store: an `optuna.artifacts` store.
    voice: warns of an image that should be there and cannot be read.
    """

    def __init__(self, store: Any, voice: Voice) -> None:
        self._store, self._voice = store, voice

    def save(self, trial: Trial, image: Float32) -> None:
        """Upload an image (H, W, 3) as PNG of 8 bits, which Optuna Dashboard shows."""
        pixels = np.round(image * 255).astype(np.uint8)
        with tempfile.TemporaryDirectory(prefix="fide-") as folder:
            path = Path(folder, "image.png")
            Image.fromarray(pixels).save(path)
            upload_artifact(
                artifact_store=self._store,
                file_path=str(path),
                study_or_trial=trial,
                mimetype="image/png",
            )

    def load(
        self, trial: FrozenTrial, storage: BaseStorage, shape: tuple[int, ...]
    ) -> Float32 | None:
        """Image (1, H, W, 3) of a trial, of a target's shape (H, W, 3); None if it has none."""
        if not any(key.startswith(_PREFIX) for key in trial.system_attrs):
            return None
        try:
            for meta in get_all_artifact_meta(trial, storage=storage):
                if str(meta.mimetype).startswith("image/"):
                    return as_batch([Image.open(io.BytesIO(self._read(meta.artifact_id)))], shape)
        except Exception as error:
            if not isinstance(error, _SIGN_OF_ERROR) and not _is_of_optuna(error):
                raise
            self._voice.warn(
                "artifacts",
                f"the image of trial {trial.number} in the artifact store cannot be used, so the "
                f"trial counts without it: {error or type(error).__name__}",
            )
        return None

    def _read(self, name: object) -> bytes:
        if not isinstance(name, str) or PurePath(name).name != name:
            raise ValueError(f"no name of an artifact: {name!r}")  # it could lead anywhere
        with self._store.open_reader(name) as reader:
            data: bytes = reader.read(_MOST_BYTES)
        return data


def _is_of_optuna(error: Exception) -> bool:
    return type(error).__module__.startswith("optuna.")
