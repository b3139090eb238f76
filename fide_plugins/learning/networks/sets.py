"""Exchangeable blocks of parameters as a set: which one comes first cannot be learned.

As many queries as blocks attend to the places of the image and to each other, and each predicts one
block. Queries and blocks are matched by the Hungarian method (set prediction, Carion et al. 2020,
arXiv:2005.12872). Waves of its coordinates, as strong as what is seen there, come with each place,
so that a query that finds its block by its color can say where it is. The density of blocks
u_1 ... u_n, of which no order counts, is

    p(u) = 1 / n! sum_s prod_i p_i(u_s(i)) >= 1 / n! max_s prod_i p_i(u_s(i)),  s: permutations;

`log_prob` is the logarithm of the right side, so that it never says too much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.networks.attention import attend, split
from fide_plugins.learning.networks.axes import NUMBERS, Components, fourier
from fide_plugins.learning.networks.heads import Autoregressive
from fide_plugins.learning.networks.trainable import linear

__all__ = ["Blocks"]

_WIDTH, _HEADS, _LAYERS = 96, 4, 3


class Blocks(nn.Module):
    """Queries for the exchangeable blocks; all other axes by an `Autoregressive` head.

    channels, grid: of the encoder's map, grid its height and width.  width: of its vector.
    periodic: (d,) bool.  blocks: (n, L), axes of each block.
    """

    periodic: Tensor
    blocks: Tensor
    waves: Tensor

    def __init__(
        self,
        channels: int,
        grid: tuple[int, int],
        width: int,
        periodic: Tensor,
        blocks: Sequence[Sequence[int]],
    ) -> None:
        super().__init__()
        index = torch.tensor([list(block) for block in blocks])  # (n, L)
        self.register_buffer("blocks", index, persistent=False)
        self.register_buffer("periodic", periodic[index[0]], persistent=False)
        others = [i for i in range(len(periodic)) if i not in set(index.flatten().tolist())]
        self.others, self.dim = others, len(periodic)
        self.rest = Autoregressive(width, periodic[others]) if others else None
        self._scale = 1.0
        n, length = index.shape
        self.place_in = linear(channels, _WIDTH)
        self.register_buffer("waves", _waves(grid), persistent=False)
        self.position = linear(self.waves.shape[1], _WIDTH)
        self.query = nn.Parameter(torch.randn(n, _WIDTH, dtype=torch.float32))
        self.layers = nn.ModuleList(_Layer() for _ in range(_LAYERS))
        self.out = linear(_WIDTH, length * NUMBERS)

    def _of(self, places: Tensor) -> Components:
        """One component (B, n, L, 1) for each query."""
        seen = self.place_in(F.layer_norm(places, places.shape[-1:]))
        image = seen + self.position(self.waves)  # (B, places, W)
        h = self.query.expand(len(places), -1, -1)
        for layer in self.layers:
            h = layer(h, image)
        raw = self.out(F.layer_norm(h, h.shape[-1:]))
        raw = raw.view(len(places), len(self.blocks), -1, 1, NUMBERS)
        return Components.of(raw, self.periodic).widened(self._scale)

    @property
    def scale(self) -> float:
        """See `heads.Head`; that of the other axes, too."""
        return self._scale

    @scale.setter
    def scale(self, scale: float) -> None:
        self._scale = scale
        if self.rest is not None:
            self.rest.scale = scale

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """See `heads.Head`; a lower bound, see the module's text."""
        found = self._of(places)
        mean, std = (t[:, :, None] for t in (found.mean, found.std))  # (B, n, 1, L, 1)
        pairs = Components(found.weight[:, :, None], mean, std, found.periodic)
        blocks = u[:, self.blocks][:, None]  # (B, 1, n, L)
        gain = pairs.log_mixture(blocks).sum(dim=-1)  # (B, queries, blocks)
        matched = gain.gather(2, _matching(gain)[..., None])[..., 0].sum(dim=-1)
        total = matched - math.lgamma(len(self.blocks) + 1)
        if self.rest is not None:
            total = total + self.rest.log_prob(places, vector, u[:, self.others])
        return total

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """See `heads.Head`; blocks in the order of the queries."""
        found = self._of(places)
        many = (n, *found.mean.shape[1:])
        weight, mean, std = (t.expand(many) for t in (found.weight, found.mean, found.std))
        u = torch.empty(n, self.dim, dtype=torch.float32)
        u[:, self.blocks] = Components(weight, mean, std, found.periodic).draw_mixture(generator)
        if self.rest is not None:
            u[:, self.others] = self.rest.sample(places, vector, n, generator)
        return u


class _Layer(nn.Module):
    """Queries attend to each other and to the image; then each is transformed by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.among = _Attention()
        self.image = _Attention()
        self.inner, self.outer = linear(_WIDTH, 2 * _WIDTH), linear(2 * _WIDTH, _WIDTH)

    def forward(self, h: Tensor, image: Tensor) -> Tensor:
        """Queries (B, n, W), image (B, places, W) -> (B, n, W)."""
        normal = F.layer_norm(h, h.shape[-1:])
        h = h + self.among(normal, normal)
        h = h + self.image(F.layer_norm(h, h.shape[-1:]), image)
        inner = F.gelu(self.inner(F.layer_norm(h, h.shape[-1:])))
        out: Tensor = h + self.outer(inner)
        return out


class _Attention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.query, self.key_value = linear(_WIDTH, _WIDTH), linear(_WIDTH, 2 * _WIDTH)
        self.out = linear(_WIDTH, _WIDTH)

    def forward(self, h: Tensor, of: Tensor) -> Tensor:
        keys, values = self.key_value(of).chunk(2, dim=-1)
        q, k, v = (split(t, _HEADS) for t in (self.query(h), keys, values))
        out: Tensor = self.out(attend(q, k, v))
        return out


def _waves(grid: tuple[int, int]) -> Tensor:
    """Waves (h * w, 18) of the middle of each place of a map of h x w places, row by row."""
    y, x = ((torch.arange(side, dtype=torch.float32) + 0.5) / side for side in grid)
    middles = torch.cartesian_prod(y, x)  # (h * w, 2)
    return fourier(middles, torch.tensor([False, False])).flatten(1)


def _matching(gain: Tensor) -> Tensor:
    """Block (B, n) for each query by which the sum of gains (B, queries, blocks) is largest."""
    values = np.nan_to_num(gain.detach().cpu().numpy(), nan=-1e9, posinf=1e9, neginf=-1e9)
    found = [linear_sum_assignment(each, maximize=True)[1] for each in values]
    return torch.from_numpy(np.array(found, np.int64)).to(gain.device)
