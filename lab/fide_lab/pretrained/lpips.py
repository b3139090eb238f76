"""The `lpips` loss: learned perceptual image patch similarity 0.1, of AlexNet (Zhang et al. 2018).

With y_l the activations of layer l, of unit length over the channels, and learned w_l >= 0,

    loss = sum_l  mean over places of  sum_c w_lc (y_lc - y'_lc)^2.

The w_l are part of the package `lpips`, of which nothing is imported.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from fide_lab.pretrained import backbones, weights as weights_module
from fide_lab.pretrained.weights import Published
from fide_plugins.errors import ImageError, WeightsMismatchError
from fide_plugins.losses.base import LossOfTarget
from fide_plugins.runtime.devices import batch_size, digest, in_batches, on_device, resolve_device
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32, Float64

# input of the network: (2 image - 1 - SHIFT) / SCALE
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
LAYERS, CHANNELS = (1, 4, 7, 9, 11), (64, 192, 384, 256, 256)  # that are compared
SMALLEST = 31  # pixels of a side, for which the last layer is not empty
_TINY = 1e-10
_AT_ONCE = 64  # images copied to the device together
_HEADS = Published(
    "LPIPS 0.1 (alex)",
    "lpips-v0.1-alex.pth",
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
    "alex.pth",
    "df73285e",
)
_HOW = (
    "; losses.make('lpips', target, download=True) fetches both of its files once, the network's "
    f"from {backbones.ALEXNET.url}, losses.make(..., weights=PATH, heads=PATH) reads "
    "files of yours, and the loss 'perceptual' needs none"
)


class LPIPSLoss(LossOfTarget):
    """Distance of deep features of AlexNet, with weights learned from human judgments.

    weights: torchvision's file of the network; None: the file in PyTorch's cache.
    heads: file of the w_l; None: that of the package `lpips`, or the file in PyTorch's cache.
    download: download missing files into that cache.
    device: of the network; "auto": CUDA if it is available.

    Raises ImageError for a target too small for the network, WeightsNotFoundError, and
    WeightsMismatchError for a file that does not fit, or has a w_l below 0.
    """

    name = "lpips"

    def __init__(
        self,
        target: object,
        *,
        weights: str | os.PathLike[str] | None = None,
        heads: str | os.PathLike[str] | None = None,
        download: bool = False,
        device: str | torch.device = "auto",
    ) -> None:
        super().__init__(target)
        height, width, _ = self.target.shape
        if min(height, width) < SMALLEST:
            raise ImageError(
                f"lpips needs images of at least {SMALLEST} x {SMALLEST} pixels, got "
                f"{height} x {width} (H x W); enlarge them, or use the loss 'perceptual'"
            )
        self._device = resolve_device(device)
        network = backbones.load(backbones.ALEXNET, weights, download=download, how=_HOW)
        read = _read_heads(heads, download)
        self.version = f"lpips-2-alex-{digest(network, read)}"
        self._network = network.to(self._device)
        self._heads = [head.to(self._device) for head in read.state_dict().values()]
        self._shift = torch.tensor(SHIFT, dtype=torch.float32, device=self._device)
        self._scale = torch.tensor(SCALE, dtype=torch.float32, device=self._device)
        self._target_features = self._features_of_target()

    @user_threads
    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of a canonical batch (n, H, W, 3), without further checks."""
        losses = np.empty(len(batch))
        size = batch_size(self._device, *self.target.shape[:2])
        for start in range(0, len(batch), _AT_ONCE):
            piece = on_device(batch[start : start + _AT_ONCE], self._device)
            values = in_batches(self._distances, piece, size)
            losses[start : start + _AT_ONCE] = values.cpu().numpy()
        return losses

    def _distance(self, image: Float32) -> float:
        return float(self.compute(image[None])[0])

    @torch.inference_mode()
    def _distances(self, images: Tensor) -> Tensor:
        """Losses (n,), float64, of images (n, H, W, 3)."""
        total = torch.zeros(len(images), dtype=torch.float64, device=self._device)
        features = self._features(images)
        for own, target, head in zip(features, self._target_features, self._heads, strict=True):
            squares = (own - target).square() * head  # (n, C, h, w)
            total += squares.sum(dim=1).mean(dim=(1, 2))
        return total

    def _features(self, images: Tensor) -> list[Tensor]:
        """Activations of each layer for images (n, H, W, 3), of unit length over the channels."""
        seen = (2 * images - 1 - self._shift) / self._scale
        layers = self._network.taps(seen.permute(0, 3, 1, 2).contiguous(), LAYERS)
        return [y / (y.square().sum(dim=1, keepdim=True).sqrt() + _TINY) for y in layers]

    @user_threads
    @torch.inference_mode()
    def _features_of_target(self) -> list[Tensor]:
        """Activations of the target, (1, C, h, w) each, computed in a batch of the usual size."""
        target = on_device(self.target, self._device)
        batch = target.expand(batch_size(self._device, *target.shape[:2]), *target.shape)
        return [y[:1] for y in self._features(batch)]


class _Heads(nn.Module):
    """The w_l, with the names of their file: lin0.model.1.weight, (1, C, 1, 1)."""

    def __init__(self) -> None:
        super().__init__()
        for i, c in enumerate(CHANNELS):
            head = nn.Sequential(nn.Identity(), nn.Conv2d(c, 1, 1, bias=False))
            self.add_module(f"lin{i}", nn.ModuleDict({"model": head}))


def _read_heads(given: str | os.PathLike[str] | None, download: bool) -> _Heads:
    """Read the w_l, (1, C, 1, 1) each, also from the package `lpips`, which is not imported."""
    package = find_spec("lpips")
    places: Sequence[str] = (package.submodule_search_locations if package else None) or []
    others = [Path(place, "weights", "v0.1", "alex.pth") for place in places]
    path = _HEADS.find(given, others=others, download=download, how=_HOW)
    with torch.device("meta"):
        heads = _Heads()
    weights_module.fill(heads, weights_module.read(path), path)
    for key, head in heads.state_dict().items():
        if (head < 0).any():
            raise WeightsMismatchError(
                f"{path}: {key!r} has values below 0, the least {float(head.min()):g}, with which "
                "LPIPS is no distance; take the file of the package lpips"
            )
    return heads
