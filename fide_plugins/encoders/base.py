"""Base class of encoders: validation, batches of bounded size, the device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager

import torch

from fide_plugins.errors import CheckpointError
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.devices import on_device, resolve_device
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_batch

CHUNK = 2**21  # values of the images encoded at a time: 8 MB, which fit a CPU's cache


class PatchEncoder(ABC):
    """Turns images into tokens of patches.

    A subclass defines `name`, `version`, `shape` and `_encode`.  The features of an image must not
    depend on the other images of a batch.
    """

    name: str
    """Name in `fide_plugins.encoders`."""
    uses_network: bool = True
    """Whether a GPU makes it faster."""
    version: str
    """Changes whenever the features of an image change."""
    weights_digest: str | None = None
    """Which pretrained weights its network has; None without."""
    channel_subsets: tuple[int | None, ...] = (None,)
    """Sets of features for linear models: so many leading channels; None: all."""
    threads: AbstractContextManager[None] = user_threads
    """In which it computes; `one_thread` for those that do little with each pixel."""

    def __init__(self, *, device: str | torch.device = "cpu") -> None:
        self.device = resolve_device(device)

    def __call__(self, images: object) -> torch.Tensor:
        """Tokens, float32 (n, T, C) on the encoder's device.

        images: (n, H, W, C) or any other input of `as_batch`; `ImageError` otherwise.
        """
        return self.compute(as_batch(images))

    @torch.no_grad()
    def compute(self, batch: Float32) -> torch.Tensor:
        """Tokens (n, T, C) of a canonical batch, without further checks."""
        n, height, width, _ = batch.shape
        tokens, channels = self.shape(height, width)
        out = torch.empty((n, tokens, channels), dtype=torch.float32, device=self.device)
        step = max(1, CHUNK // (height * width * 3))
        with self.threads:
            for start in range(0, n, step):
                chunk = on_device(self._prepare(batch[start : start + step]), self.device)
                out[start : start + step] = self._encode(chunk)
        return out

    def check_version(self, saved: object) -> None:
        """Raise CheckpointError unless saved features, of the version `saved`, are of this one."""
        if saved != self.version:
            raise CheckpointError(
                f"the saved state has features of the encoder {saved}; the one here is "
                f"{self.version}: {checkpoint.VERSION_REMEDY}, or start again"
            )

    @abstractmethod
    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) for images of that size; `ImageError` if they are too small."""

    def _prepare(self, batch: Float32) -> Float32:
        """Input of `_encode` for images (n, H, W, 3), on the CPU; by default the images."""
        return batch

    @abstractmethod
    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        """Tokens (n, T, C) of the output of `_prepare`."""
