"""What `training.one_training` trains: networks with weights by name, on one device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["Trainable", "linear", "mean_and_variance"]


def linear(inputs: int, outputs: int) -> nn.Linear:
    """Layer in single precision, whatever PyTorch's default is."""
    return nn.Linear(inputs, outputs, dtype=torch.float32)


class Trainable(nn.Module, ABC):
    """A network that learns from renders: images (B, 3, H, W) in [0, 1] and points u (B, d)."""

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next(self.parameters()).device

    def load(self, weights: Mapping[str, Any]) -> None:
        """Take weights by name.

        Raises RuntimeError (of PyTorch) where they do not fit, ValueError for one that is not
        finite, also only in the precision of the network.
        """
        self.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
        for name, weight in self.state_dict().items():
            if not torch.isfinite(weight).all():
                raise ValueError(f"the weight {name!r} is not finite")

    @abstractmethod
    def standardize(self, images: Tensor) -> None:
        """Take from some of the images, on any device, how they differ."""

    @abstractmethod
    def loss(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """What a step of training makes smaller, a number."""

    @abstractmethod
    def judged(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """What held-out renders are judged by, a number; smaller is better."""


def mean_and_variance(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (3, H, W) of images (B, 3, H, W), and their variance, a number that is not 0."""
    mean = images.mean(dim=0)
    return mean, (images - mean).square().mean().clamp_min(1e-6)
