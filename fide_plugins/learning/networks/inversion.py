"""From a picture to its parameters through a learned renderer: descent from many points at once.

Adam (Kingma and Ba 2015, arXiv:1412.6980) on the logits of the parameters, each step at other
random places of the image.  First all points take large steps, then the best of them small ones at
more places.  Most of the points end in local optima; what finds the picture is their number.
Integers and choices are coordinates as in a search, and an emulator is smooth where they step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fide_plugins.learning.networks.emulator import Emulator

__all__ = ["inverted"]

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
    """Points (at most 8, d) of the unit cube whose emulated images are nearest to an image.

    The best one is first.

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
