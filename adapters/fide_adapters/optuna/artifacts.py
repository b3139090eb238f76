"""Images of trials in an artifact store, where people can see them and other processes read them.

Optuna records an artifact before it stores the artifact, and a store may lose one.  If an image
cannot be read, for whatever reason, its trial counts without it.
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

from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32
from fide_plugins.validation.pixels import warn_clipped
from fide_plugins.views import Views

__all__ = ["ImageArtifacts"]

_PREFIX = "artifacts:"  # of Optuna's attributes
_MOST_BYTES = 2**28


class ImageArtifacts:
    """The images in one artifact store.

    store: an `optuna.artifacts` store.
    warnings: where an image is reported that is recorded and cannot be read.

    Raises OptionError, a ValueError, for what is no store.
    """

    def __init__(self, store: Any, warnings: WarnOnce) -> None:
        if not (hasattr(store, "write") and hasattr(store, "open_reader")):
            raise OptionError(
                "artifact_store must be one of optuna.artifacts, such as "
                f"FileSystemArtifactStore(folder), not {store!r}"
            )
        self._store, self._warnings = store, warnings

    def save(self, trial: Trial, images: list[Float32]) -> None:
        """Upload the image (1, H, W, 3) of each view as 8-bit PNG, which Optuna Dashboard shows."""
        names = _names(len(images))
        for name, image in zip(names, images, strict=True):
            self._upload(trial, name, image[0])

    def _upload(self, trial: Trial, name: str, image: Float32) -> None:
        pixels = np.round(image * 255).astype(np.uint8)
        with tempfile.TemporaryDirectory(prefix="fide-") as folder:
            path = Path(folder, name)
            Image.fromarray(pixels).save(path)
            upload_artifact(
                artifact_store=self._store,
                file_path=str(path),
                study_or_trial=trial,
                mimetype="image/png",
            )

    def load(self, trial: FrozenTrial, storage: BaseStorage, views: Views) -> Float32 | None:
        """Image (1, H, W, 3) of a trial, packed if there are several views; None if there is none.

        Of one view it is the first image; those of several views have the names that `save` gives.
        """
        if not any(key.startswith(_PREFIX) for key in trial.system_attrs):
            return None
        try:
            metas = get_all_artifact_meta(trial, storage=storage)
            found = [meta for meta in metas if str(meta.mimetype).startswith("image/")]
            if views.listed:
                by_name = {meta.filename: meta for meta in found}
                found = [by_name[name] for name in _names(len(views.views)) if name in by_name]
            if found:
                images = [self._image(meta.artifact_id) for meta in found]
                image = images if views.listed else images[0]
                return views.canonical.batch_of_one(image, warn_clipped)  # `save` has scaled it
        except Exception as error:  # whatever the store's client or PIL raises
            self._warnings.warn(
                "artifacts",
                f"the image of trial {trial.number} in the artifact store cannot be used, so the "
                f"trial counts without it: {error or type(error).__name__}",
            )
        return None

    def _image(self, name: object) -> Any:
        return Image.open(io.BytesIO(self._read(name)))

    def _read(self, name: object) -> bytes:
        if not isinstance(name, str) or PurePath(name).name != name:
            raise ValueError(f"not the id of an artifact: {name!r}")  # a path could lead anywhere
        with self._store.open_reader(name) as reader:
            data: bytes = reader.read(_MOST_BYTES)
        return data


def _names(views: int) -> list[str]:
    """File names of the images of so many views."""
    return ["image.png"] if views == 1 else [f"image-{i}.png" for i in range(views)]
