"""The `learned` encoder: the features that a model of `fide_plugins.learn` has learned to see.

A model's own encoder was trained on renders, so it needs no pretrained weights, and sees what the
parameters of this renderer change.  A token is one place of its feature map: for images of 64
pixels 8 x 8 tokens.  The head of the model, which makes hypotheses of features, is not used.

Images are resized as those of the model were, but not rounded to 8 bits: near the answer, images
differ by less.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.cache import TokenCache
from fide_plugins.errors import WeightsNotFoundError
from fide_plugins.learning.model import Model
from fide_plugins.learning.renders import resized
from fide_plugins.runtime.devices import batch_size, digest, in_batches
from fide_plugins.types import Float32

__all__ = ["LearnedEncoder"]

_HOW = "`fide learn` and fide_plugins.learn make one, and encoder='learned:model.fide' reads it"


class LearnedEncoder(PatchEncoder):
    """Feature map of a model's encoder.

    Parameters
    ----------
    variant
        file of the model.
    device
        device of the network.

    Raises
    ------
    WeightsNotFoundError
        no file was named, or there is none.
    CheckpointError
        the file is damaged, or no model.

    Images of another aspect (height / width) than the model's raise ImageError.
    """

    name = "learned"

    def __init__(self, *, variant: str | None = None, device: str | torch.device = "cpu") -> None:
        super().__init__(device=device)
        self._model = _read(variant)
        self.name = f"learned:{variant}"
        network = self._model.network.encoder
        self.version = f"learned-1-{digest(network, extra=self._model.size)}"
        self._network = network.to(self.device)
        self._cache = TokenCache()

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C): places and channels of the feature map; ImageError for another aspect."""
        self._model.check_aspect(height, width)
        return self._network.places, self._network.channels

    def compute(self, batch: Float32) -> Tensor:
        """Tokens (n, T, C) of a canonical batch, without further checks."""
        return self._cache.tokens(batch, super().compute)

    def _prepare(self, batch: Float32) -> Float32:
        """Images (n, h, w, 3) of the size that the network sees."""
        small = [resized(image, self._model.size) for image in batch]
        return np.stack(small) if small else np.empty((0, *self._model.size, 3), np.float32)

    @torch.inference_mode()
    def _encode(self, images: Tensor) -> Tensor:
        size = batch_size(self.device, *self._model.size)
        return in_batches(self._places, images.permute(0, 3, 1, 2).contiguous(), size).float()

    def _places(self, images: Tensor) -> Tensor:
        places: Tensor = self._network(images)[0]
        return places


def _read(variant: str | None) -> Model:
    """Model of a file; raises the errors of `LearnedEncoder`."""
    if not variant:
        raise WeightsNotFoundError(f"the encoder 'learned' needs the file of a model: {_HOW}")
    path = Path(variant)
    try:
        return Model.load(path)
    except IsADirectoryError as error:
        raise WeightsNotFoundError(f"the encoder 'learned': {error}; {_HOW}") from error
    except OSError as error:
        reason = error.strerror or "No such file"  # a ModelNotFoundError has no number
        why = f"no model at {path.absolute()}: {reason}; {_HOW}"
        raise WeightsNotFoundError(why) from error
