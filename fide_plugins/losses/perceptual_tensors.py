"""The `perceptual` loss of a batch of tensors, on their device: the definition in `perceptual`.

Gradients are differences of neighbors, as there: kornia's `spatial_gradient` takes central ones,
and smooths them.  Axes: images n, picture and grain k, colors, rows, columns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from fide_plugins.losses.perceptual_constants import COLOR_WEIGHT, FLOOR, LEAST, LEVELS, OPPONENT

if TYPE_CHECKING:
    from fide_plugins.losses.perceptual import PerceptualLoss

__all__ = ["PerceptualDistance"]

_Weights = tuple[Tensor, Tensor]  # [samples, pixels] along rows and columns


class PerceptualDistance:
    """Distances (n,) float64 of images (n, H, W, 3) from the target of a loss.

    size: number n of images; the target's features are those of such a batch, since products of
        other shapes sum in other orders.
    """

    def __init__(self, loss: PerceptualLoss, device: torch.device, size: int) -> None:
        self._samplers = [_on(device, *weights) for weights in loss.samplers]
        first, *others = loss.levels
        # in NumPy each sampling exchanges the axes, so the finest level has columns first
        self._local = [_on(device, *first.local[::-1])]
        self._local += [_on(device, *level.local) for level in others]
        self._coarser = [_on(device, *level.samples[::-1]) for level in others]
        self._opponent = torch.from_numpy(OPPONENT).to(device)
        target = torch.tensor(loss.target).to(device).expand(size, *loss.target.shape)
        self._target = [colors[:1] for colors in self._features(target)]

    def __call__(self, images: Tensor) -> Tensor:
        """Distances (n,) of images (n, H, W, 3)."""
        features = self._features(images)
        total = torch.zeros(len(images), dtype=torch.float64, device=images.device)
        for own, target, local in zip(features, self._target, self._local, strict=True):
            g, other = _gradient(own), _gradient(target)
            squares = (g - other).square().sum(2)  # (n, k, a, b)
            contrast = (g[:, 0].square() + other[:, 0].square()).sum(1)
            means = _sampled(squares, local), _sampled(contrast, local)
            ratio = _without_noise(means[0]) / (means[1] + float(FLOOR))
            total += ratio.mean((1, 2), dtype=torch.float64)
        coarse = (features[-1] - self._target[-1]).square().sum(2)  # (n, k, a, b)
        color = _without_noise(coarse.mean((2, 3), dtype=torch.float64))
        return total / LEVELS + COLOR_WEIGHT * color

    def _features(self, images: Tensor) -> list[Tensor]:
        """Opponent colors (n, k, 3, a, b) of each level."""
        planes = images.permute(0, 3, 1, 2)
        sampled = torch.stack([_sampled(planes, weights) for weights in self._samplers], dim=1)
        finest = torch.einsum("cr,nkrab->nkcab", self._opponent, sampled)
        return [finest, *(_sampled(finest, weights) for weights in self._coarser)]


def _on(device: torch.device, rows: Any, columns: Any) -> _Weights:
    """Sparse weights as matrices on the device."""
    down, across = (torch.from_numpy(weights.toarray()).to(device) for weights in (rows, columns))
    return down, across


def _sampled(x: Tensor, weights: _Weights) -> Tensor:
    """Means (..., r, s) of x (..., h, w)."""
    down, across = weights
    return down @ x @ across.T


def _gradient(colors: Tensor) -> Tensor:
    """Differences (n, k, 6, a, b) of neighbors, right and down; 0 at the end."""
    down = torch.nn.functional.pad(colors.diff(dim=3), (0, 0, 0, 1))
    return torch.cat([down, torch.nn.functional.pad(colors.diff(dim=4), (0, 1))], dim=2)


def _without_noise(squares: Tensor) -> Tensor:
    """Squares of the picture minus those of the grain, from (n, k, ...); at least a tenth."""
    picture = squares[:, 0]
    if squares.shape[1] == 1:
        return picture
    return torch.maximum(picture - squares[:, 1], LEAST * picture)
