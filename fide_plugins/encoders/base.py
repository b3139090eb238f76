"""What all encoders share: validation, batches of bounded size, the device."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch

from fide_plugins.devices import on_device, resolve_device
from fide_plugins.images import Float32, as_batch

__all__ = ["PatchEncoder"]

CHUNK = 2**21  # values of the images that are encoded at a time: 8 MB, which a cache can hold


class PatchEncoder(ABC):
    """Images to tokens of patches.

    A subclass gives `name`, `version` and `_encode`.  Features of one image do not depend on the
    other images of a batch.
    """

    name: str
    """Name in `fide_plugins.encoders`."""
    version: str
    """Changes whenever the features of an image do."""
    views: tuple[int | None, ...] = (None,)
    """Sets of features for linear models: so many leading channels; None: all."""

    def __init__(self, *, device: str | torch.device = "cpu") -> None:
        self.device = resolve_device(device)

    def __call__(self, images: object) -> torch.Tensor:
        """Tokens of images.

        Parameters
        ----------
        images
            (n, H, W, C) or whatever else `as_batch` takes; `ImageError` otherwise.

        Returns
        -------
        float32 (n, T, C) on the encoder's device.
        """
        return self.compute(as_batch(images))

    @torch.no_grad()
    def compute(self, batch: Float32) -> torch.Tensor:
        """Tokens (n, T, C) of a canonical batch, which is not checked again."""
        n, height, width, _ = batch.shape
        tokens, channels = self.shape(height, width)
        out = torch.empty((n, tokens, channels), dtype=torch.float32, device=self.device)
        step = max(1, CHUNK // (height * width * 3))
        for start in range(0, n, step):
            chunk = on_device(self._prepare(batch[start : start + step]), self.device)
            out[start : start + step] = self._encode(chunk)
        return out

    @abstractmethod
    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) for images of that size; `ImageError` if they are too small."""

    def _prepare(self, batch: Float32) -> Float32:
        """What `_encode` shall see of images (n, H, W, 3), still on the processor."""
        return batch

    @abstractmethod
    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        """Tokens (n, T, C) of what `_prepare` made of images, (n, H, W, 3) by default."""
