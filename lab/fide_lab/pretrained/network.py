"""Base class of encoders with a frozen network: batches of fixed size, normalization of colors."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.patch import patches, resized
from fide_plugins.runtime.devices import batch_size, in_batches

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class NetworkEncoder(PatchEncoder):
    """Tokens of patches by a frozen network.

    A subclass defines `name`, `version`, `weights_digest`, `patch`, `channels` and `_features`.

    mean, std: of the network's training colors, which normalize the images.
    """

    patch: int
    """Side of a patch in pixels."""
    channels: int
    """C, the channels of a token."""

    def __init__(
        self,
        *,
        device: str | torch.device = "cpu",
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
    ) -> None:
        super().__init__(device=device)
        self._mean = torch.tensor(mean, dtype=torch.float32, device=self.device)
        self._std = torch.tensor(std, dtype=torch.float32, device=self.device)

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C), T being the number of whole patches, see `patch.patches`."""
        rows, columns = patches(self.name, self.patch, height, width)
        return rows * columns, self.channels

    @torch.inference_mode()
    def _encode(self, images: Tensor) -> Tensor:
        rows, columns = patches(self.name, self.patch, *images.shape[1:3])
        images = resized(images, rows * self.patch, columns * self.patch)
        normalized = ((images - self._mean) / self._std).permute(0, 3, 1, 2).contiguous()
        size = batch_size(self.device, *normalized.shape[2:])
        return in_batches(self._features, normalized, size).float()

    @abstractmethod
    def _features(self, images: Tensor) -> Tensor:
        """Tokens (n, T, C) of normalized images (n, 3, H, W), both sides multiples of a patch."""
