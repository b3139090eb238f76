"""The network: an encoder and a head, made again from plain settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from fide_plugins.learning.networks.encoder import Encoder
from fide_plugins.learning.networks.heads import Autoregressive, Head, Mixture
from fide_plugins.learning.networks.trainable import Trainable
from fide_plugins.learning.renders.renderer import Pixels

__all__ = ["HEADS", "Network", "as_input"]

HEADS = ("autoregressive", "mixture", "set")
_WIDTH = 256


class Network(Trainable):
    """Density of the parameters given an image.

    size: height and width of the images.
    periodic: (d,), axes that wrap around.
    head: one of `HEADS`.
    blocks: exchangeable blocks of axes, for the head "set"; the other axes have their own head.
    seed: of the initial weights.
    """

    def __init__(
        self,
        size: tuple[int, int],
        periodic: Sequence[bool],
        head: str = "autoregressive",
        blocks: Sequence[Sequence[int]] = (),
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.size, self.dim = size, len(periodic)
        with torch.random.fork_rng(devices=[]):  # the global generator stays as it was
            torch.default_generator.manual_seed(seed)
            self.encoder = Encoder(size, _WIDTH)
            self.head = self._make_head(head, torch.tensor(periodic), blocks)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def _make_head(self, head: str, periodic: Tensor, blocks: Sequence[Sequence[int]]) -> Any:
        if head == "set":
            from fide_plugins.learning.networks.sets import Blocks

            return Blocks(self.encoder.channels, self.encoder.grid, _WIDTH, periodic, blocks)
        kind: Any = Mixture if head == "mixture" else Autoregressive
        return kind(_WIDTH, periodic)

    @property
    def density(self) -> Head:
        """The head."""
        head: Head = self.head
        return head

    @property
    def scale(self) -> float:
        """Of the standard deviations of the density, see `judging.calibration`; no weight."""
        return self.density.scale

    @scale.setter
    def scale(self, scale: float) -> None:
        self.density.scale = scale

    def log_prob(self, images: Tensor, u: Tensor) -> Tensor:
        """Logarithm of the density (B,) at u (B, d), given images (B, 3, H, W), or one for all."""
        places, vector = self.encoder(images)
        return self.density.log_prob(places, vector, u)

    def standardize(self, images: Tensor) -> None:
        """Take mean image and contrast from images (B, 3, H, W), on any device."""
        self.encoder.standardize(images)

    def loss(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood in nats; nothing of it is drawn by the generator."""
        return -self.log_prob(images, u).mean()

    def judged(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """The same."""
        return self.loss(images, u, generator)

    @torch.no_grad()
    def vectors(self, images: Tensor) -> Tensor:
        """Features (B, width) of images (B, 3, H, W)."""
        vector: Tensor = self.encoder(images)[1]
        return vector

    @torch.no_grad()
    def sample(self, image: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Draw (n, d) given one image (1, 3, H, W)."""
        places, vector = self.encoder(image)
        return self.density.sample(places, vector, n, generator)


def as_input(images: Pixels, device: torch.device | str = "cpu") -> Tensor:
    """Images (B, H, W, 3) uint8 as a network takes them, (B, 3, H, W) in [0, 1], on its device."""
    return torch.from_numpy(images).to(device).permute(0, 3, 1, 2).float() / 255
