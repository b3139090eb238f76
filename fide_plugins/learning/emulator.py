"""A learned renderer has gradients: parameters of a picture are found by descent through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.networks import (
    WAVES,
    Blocking,
    Trainable,
    attend,
    fourier,
    linear,
    mean_and_variance,
    split,
    waves_of,
)

_WIDTH, _HEADS = 96, 4
_SUMMED = 32  # numbers of each block of which a place gets the mean
_JUDGED = 2048  # places at which a held-out render is judged
_NUMBERS = 2**25  # 128 MB, of features that are there at once where no gradient keeps them
_PLACES = 64  # of each image in a step of training: twice as many cost twice, and learn no more


class Emulator(Trainable):
    """Colors of an image at some of its places, given points of the unit cube.

    It is for scenes that are a set of similar things (cells, lamps, sprites).  At each place of the
    image attention says which block is seen, where one covers the others, and a mean over all
    blocks says what each does there, where they add up: no order of the blocks is learned.  Other
    parameters scale and shift the features of the places (FiLM, Perez et al. 2018,
    arXiv:1709.07871).  Such a network is a conditional neural field (Sajjadi et al. 2022,
    arXiv:2111.13152).

    size: (H, W) of the images, whose pixels are the places, row by row.
    periodic: (d,), axes that wrap around.  blocks: (n, L), exchangeable axes, n >= 1.
    """

    blocks: Tensor
    others: Tensor
    periodic: Tensor
    pixels: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(
        self, size: tuple[int, int], periodic: Sequence[bool], blocks: Blocking, seed: int = 0
    ) -> None:
        super().__init__()
        self.size, self.dim = size, len(periodic)
        index, wraps = torch.tensor([list(block) for block in blocks]), torch.tensor(periodic)
        others = sorted(set(range(self.dim)) - set(index.flatten().tolist()))
        rest = torch.tensor(others, dtype=torch.long)
        self.register_buffer("blocks", index, persistent=False)
        self.register_buffer("others", rest, persistent=False)
        self.register_buffer("periodic", wraps, persistent=False)
        waves = waves_of(*size, max(size), max(size))  # the longer side is 1
        self.register_buffer("pixels", waves, persistent=False)
        self.register_buffer("mean", torch.zeros(size[0] * size[1], 3, dtype=torch.float32))
        self.register_buffer("variance", torch.ones((), dtype=torch.float32))
        with torch.random.fork_rng(devices=[]):  # the global generator stays as it was
            torch.default_generator.manual_seed(seed)
            self.block = _perceptron(index.shape[1] * WAVES, _WIDTH)
            self.place = _perceptron(self.pixels.shape[1], _WIDTH)
            self.film = _perceptron(len(others) * WAVES, 2 * _WIDTH) if others else None
            self.gather = _Gather()
            self.color = _perceptron(_WIDTH, 3)

    def forward(self, u: Tensor, places: Tensor) -> Tensor:
        """Colors (B, P, 3) in the image of each of the points u (B, d), at places (P,)."""
        of_blocks = self.block(
            fourier(u[:, self.blocks], self.periodic[self.blocks[0]]).flatten(2)
        )  # (B, n, W)
        of_places = self.place(self.pixels[places])[None]  # (1, P, W)
        if self.film is not None:
            waves = fourier(u[:, self.others], self.periodic[self.others]).flatten(1)
            scale, shift = self.film(waves)[:, None].chunk(2, dim=-1)
            of_places = of_places * (1 + scale) + shift
        seen = of_places + self.gather(of_places, of_blocks)
        colors: Tensor = self.mean[places] + self.variance.sqrt() * self.color(seen)
        return colors

    def standardize(self, images: Tensor) -> None:
        """Take mean image and variance from images (B, 3, H, W), on any device."""
        mean, variance = mean_and_variance(images)
        self.mean.copy_(mean.flatten(1).T)  # (places, 3)
        self.variance.copy_(variance)

    def errors(self, images: Tensor, u: Tensor, places: Tensor) -> Tensor:
        """Mean squared errors (B,) of the colors at places (P,); images: (B or 1, 3, H, W)."""
        errors: Tensor = (self(u, places) - _colors(images, places)).square().mean(dim=(1, 2))
        return errors

    @torch.no_grad()
    def errors_of_many(self, images: Tensor, u: Tensor, places: Tensor) -> Tensor:
        """As `errors`, in parts: memory does not grow with the number of points and places."""
        numbers = 6 * _WIDTH + (2 * _SUMMED + _HEADS) * len(self.blocks)  # of one place
        parts, errors = torch.split(places, max(1, _NUMBERS // numbers)), []
        pairs = zip(images.expand(len(u), -1, -1, -1), u, strict=True)
        for image, at in ((image[None], at[None]) for image, at in pairs):
            sums = [self.errors(image, at, part) * len(part) for part in parts]
            errors.append(torch.stack(sums).sum(dim=0) / len(places))
        return torch.cat(errors)

    def loss(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Share of the images' variance that it does not explain, at random places."""
        some = self.random_places(_PLACES, generator)
        return self.errors(images, u, some).mean() / self.variance

    def judged(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """As `loss`, of the variance of these images, at more places: a small thing counts."""
        some = self.random_places(_JUDGED, generator)
        variance = (_colors(images, some) - self.mean[some]).square().mean().clamp_min(1e-6)
        share: Tensor = self.errors_of_many(images, u, some).mean() / variance
        return share

    def random_places(self, n: int, generator: torch.Generator) -> Tensor:
        """Draw n places (n,), some of them more than once."""
        device = generator.device
        return torch.randint(len(self.pixels), (n,), generator=generator, device=device)


class _Gather(nn.Module):
    """What each place gets of all blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.query, self.key_value = linear(_WIDTH, _WIDTH), linear(_WIDTH, 2 * _WIDTH)
        self.sharpness = nn.Parameter(  # an edge is a narrow softmax
            torch.zeros(_HEADS, 1, 1, dtype=torch.float32)
        )
        self.here, self.there = linear(_WIDTH, _SUMMED), linear(_WIDTH, _SUMMED)
        self.mix = _perceptron(_WIDTH + _SUMMED, _WIDTH)

    def forward(self, places: Tensor, blocks: Tensor) -> Tensor:
        """Places (B or 1, P, W) and blocks (B, n, W) -> (B, P, W)."""
        keys, values = self.key_value(blocks).chunk(2, dim=-1)
        query, key, value = (split(t, _HEADS) for t in (self.query(places), keys, values))
        query = query * self.sharpness.exp()
        query = query.expand(len(blocks), -1, -1, -1)
        seen = attend(query, key, value)
        each = F.relu(self.here(places)[:, :, None] + self.there(blocks)[:, None])  # (B, P, n, S)
        mixed: Tensor = self.mix(torch.cat([seen, each.mean(dim=2)], dim=-1))
        return mixed


def _perceptron(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        linear(inputs, _WIDTH), nn.ReLU(), linear(_WIDTH, _WIDTH), nn.ReLU(),
        linear(_WIDTH, outputs),
    )  # fmt: skip


def _colors(images: Tensor, places: Tensor) -> Tensor:
    """Colors (B, P, 3) of images (B, 3, H, W) at places (P,)."""
    return images.flatten(2)[:, :, places].transpose(1, 2)


# -- from a picture to its parameters --------------------------------------------------------------


_INSIDE = 1e-3  # from a face of the cube, where logits end


@dataclass(frozen=True)
class _Stage:
    """Steps of the best `points`, each at `places`, while the rate falls from `first` to `last`."""

    points: int
    places: int
    steps: int
    first: float
    last: float


_STAGES = (_Stage(32, 128, 150, 0.2, 0.03), _Stage(8, 512, 150, 0.03, 3e-4))


def inverted(emulator: Emulator, image: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
    """Points (at most 8, d) of the unit cube whose emulated images are nearest first.

    image: (1, 3, H, W) in [0, 1].  u: (n, d) in [0, 1], where descents begin, the best 32 of them.
    generator: of the places; same generator, same points.
    """
    for stage in _STAGES:
        u = _nearest_first(emulator, image, u)[: stage.points]
        u = _descended(emulator, image, u, stage, generator)
    return _nearest_first(emulator, image, u)


def _nearest_first(emulator: Emulator, image: Tensor, u: Tensor) -> Tensor:
    """Points (n, d), those whose images (all pixels of them) are nearest first."""
    everywhere = torch.arange(emulator.size[0] * emulator.size[1])
    return u[torch.argsort(emulator.errors_of_many(image, u, everywhere), stable=True)]


@torch.enable_grad()
def _descended(
    emulator: Emulator, image: Tensor, u: Tensor, stage: _Stage, generator: torch.Generator
) -> Tensor:
    """Points (n, d) after the steps of a stage."""
    free = _free(u, emulator.periodic).requires_grad_()
    optimizer = torch.optim.Adam([free])
    for step in range(stage.steps):
        (group,) = optimizer.param_groups
        group["lr"] = stage.first * (stage.last / stage.first) ** (step / stage.steps)
        optimizer.zero_grad(set_to_none=True)
        places = emulator.random_places(stage.places, generator)
        errors = emulator.errors(image, _bounded(free, emulator.periodic), places)
        errors.sum().backward(inputs=[free])  # type: ignore[no-untyped-call]
        optimizer.step()
    return _bounded(free.detach(), emulator.periodic)


def _free(u: Tensor, periodic: Tensor) -> Tensor:
    """Points of the cube as numbers without bounds: logits, and four times a periodic axis."""
    return torch.where(periodic, 4 * u, torch.logit(u, _INSIDE))


def _bounded(free: Tensor, periodic: Tensor) -> Tensor:
    """Inverse of `_free`: points of the cube."""
    turns = free / 4
    return torch.where(periodic, turns - turns.floor(), torch.sigmoid(free))
