"""Heads: what a picture's features say of the parameters, as a density on the unit cube.

================  ================================================================================
`Mixture`         K diagonal Gaussians of all parameters at once (Bishop 1994)
`Autoregressive`  one parameter after the other, each a mixture given those before it (RNADE, Uria,
                  Murray and Larochelle 2013, arXiv:1306.0186): parameters that depend on each
                  other, and many modes
`sets.Blocks`     exchangeable blocks of parameters, as a set
================  ================================================================================
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.networks.axes import NUMBERS, Components, choose, fourier, frequencies
from fide_plugins.learning.networks.trainable import linear

__all__ = ["Autoregressive", "Head", "Mixture"]


class Head(Protocol):
    """Density of u (d,) given features.

    scale: of all standard deviations, see `judging.calibration`.
    """

    scale: float

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """Logarithm of the density (B,) at u (B, d); features (B, places, C) and (B, width).

        Features of one picture, (1, places, C) and (1, width), are those of all u.
        """
        ...

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Draw (n, d) given the features of one picture, (1, places, C) and (1, width)."""
        ...


class Mixture(nn.Module):
    """sum_k w_k prod_i p(u_i; m_ki, s_ki), see `axes`.

    width: of the features.  periodic: (d,) bool.  components: K.  hidden: units between.
    """

    periodic: Tensor

    def __init__(
        self, width: int, periodic: Tensor, components: int = 8, hidden: int = 256
    ) -> None:
        super().__init__()
        self.components, self.scale = components, 1.0
        self.register_buffer("periodic", periodic, persistent=False)
        numbers = len(periodic) * components * NUMBERS
        self.layers = nn.Sequential(linear(width, hidden), nn.GELU(), linear(hidden, numbers))

    def _of(self, vector: Tensor) -> tuple[Tensor, Components]:
        """Log weights (B, K) and components (B, d, K)."""
        raw = self.layers(vector).view(len(vector), len(self.periodic), self.components, NUMBERS)
        found = Components.of(raw, self.periodic, normalize=False).widened(self.scale)
        return F.log_softmax(found.weight.mean(dim=1), dim=-1), found

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """See `Head`."""
        weight, found = self._of(vector)
        total: Tensor = torch.logsumexp(weight + found.log_density(u).sum(dim=1), dim=-1)
        return total

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """See `Head`."""
        weight, found = self._of(vector)
        which = choose(weight.expand(n, -1), generator)[:, None].expand(-1, len(self.periodic))
        d, k = len(self.periodic), self.components
        mean, std = found.mean.expand(n, d, k), found.std.expand(n, d, k)
        return Components(found.weight, mean, std, found.periodic).draw(which, generator)


class Autoregressive(nn.Module):
    """prod_i p(u_i | u_1 ... u_(i-1)), each a mixture of K Gaussians, see `axes`.

    width: of the features.  periodic: (d,) bool.  components: K.  hidden: units of each parameter.
    """

    periodic: Tensor

    def __init__(self, width: int, periodic: Tensor, components: int = 6, hidden: int = 96) -> None:
        super().__init__()
        d = len(periodic)
        self.components, self.hidden, self.scale = components, hidden, 1.0
        self.register_buffer("periodic", periodic, persistent=False)
        self.register_buffer("before", _before(d), persistent=False)
        self.context = linear(width, d * hidden)
        self.earlier = nn.Parameter(_uniform((d * frequencies(), d * hidden), d * frequencies()))
        self.second = nn.Parameter(_uniform((d, hidden, hidden), hidden))
        self.out = nn.Parameter(_uniform((d, hidden, components * NUMBERS), hidden))
        self.second_bias = nn.Parameter(torch.zeros(d, 1, hidden, dtype=torch.float32))
        self.out_bias = nn.Parameter(
            0.5 * torch.randn(d, 1, components * NUMBERS, dtype=torch.float32)
        )

    before: Tensor

    def _of(self, vector: Tensor, u: Tensor) -> Components:
        """Components (B, d, K), those of u_i given features and the parameters before i."""
        d, hidden = len(self.periodic), self.hidden
        waves = fourier(u, self.periodic).flatten(1)  # (B, d * 9)
        earlier = self._earlier() * self.before[:, None, :, None]
        h = F.gelu(self.context(vector) + waves @ earlier.view_as(self.earlier))
        h = h.view(-1, d, hidden).transpose(0, 1)  # (d, B, hidden)
        h = F.gelu(torch.baddbmm(self.second_bias, h, self.second)) + h
        raw = torch.baddbmm(self.out_bias, h, self.out).transpose(0, 1)
        return self._components(raw, self.periodic)

    def _of_one(self, i: int, context: Tensor, waves: Tensor) -> Components:
        """Components (n, 1, K) of u_i alone, as `_of` has them but for rounding.

        context: (d, hidden), of one picture.  waves: (n, i * 9), of the parameters before i.
        """
        h = F.gelu(context[i] + waves @ self._earlier()[:i, :, i].flatten(0, 1))
        h = F.gelu(self.second_bias[i] + h @ self.second[i]) + h
        return self._components(self.out_bias[i] + h @ self.out[i], self.periodic[i : i + 1])

    def _components(self, raw: Tensor, periodic: Tensor) -> Components:
        """Components (B, d, K) of as many numbers as they need."""
        raw = raw.reshape(len(raw), len(periodic), self.components, NUMBERS)
        return Components.of(raw, periodic).widened(self.scale)

    def _earlier(self) -> Tensor:
        """Weights (d, 9, d, hidden) from the waves of each parameter to the units of each."""
        d = len(self.periodic)
        return self.earlier.view(d, frequencies(), d, self.hidden)

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """See `Head`."""
        density: Tensor = self._of(vector, u).log_mixture(u)
        return density.sum(dim=-1)

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """See `Head`."""
        d, k = len(self.periodic), self.components
        context: Tensor = self.context(vector).view(d, self.hidden)
        u, waves = context.new_empty(n, d), context.new_empty(n, d, frequencies())
        # each step draws for all axes, so that a seed draws the same in every version
        zeros = context.new_zeros(n, d, k)
        found = Components(zeros, zeros + 0.5, zeros + 1, self.periodic[:, None])
        for i in range(d):
            one = self._of_one(i, context, waves[:, :i].flatten(1))
            found.weight[:, i], found.mean[:, i], found.std[:, i] = (
                part[:, 0] for part in (one.weight, one.mean, one.std)
            )
            u[:, i] = found.draw_mixture(generator)[:, i]
            waves[:, i] = fourier(u[:, i : i + 1], self.periodic[i : i + 1])[:, 0]
        return u


def _before(d: int) -> Tensor:
    """(d, d), 1 where the row comes before the column."""
    return torch.ones(d, d, dtype=torch.float32).triu(1)


def _uniform(shape: tuple[int, ...], inputs: int) -> Tensor:
    drawn: Tensor = (2 * torch.rand(shape, dtype=torch.float32) - 1) / inputs**0.5
    return drawn
