"""Networks: from a picture to a density of the parameters on the unit cube."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.renders import Pixels


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
        """Take weights by name; RuntimeError where they do not fit, ValueError if not finite."""
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

    def judged(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """What held-out renders are judged by, a number; smaller is better."""
        return self.loss(images, u, generator)


def mean_and_variance(images: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (3, H, W) of images (B, 3, H, W), and their variance, a number that is not 0."""
    mean = images.mean(dim=0)
    return mean, (images - mean).square().mean().clamp_min(1e-6)


# -- encoder ---------------------------------------------------------------------------------------


_MAP_SIDE = 8  # on the longer side of the map, at most
_CHANNELS = (48, 96, 128, 160, 192, 224)  # after each convolution
_TOP = 160  # channels of the last convolution
_SIDES = {4: 6, 2: 3}  # of a kernel, by the stride
_LARGE = 48  # pixels from which the first convolution has a stride of 4


class Encoder(nn.Module):
    """Images (B, 3, H, W) in [0, 1] -> map (B, places, channels) and vector (B, width).

    Images are standardized: what a parameter changes may be a small part of one.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, size: tuple[int, int], width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(3, *size, dtype=torch.float32))
        self.register_buffer("std", torch.ones((), dtype=torch.float32))
        steps = _steps(max(size))
        channels = [3, *(_CHANNELS[min(i, len(_CHANNELS) - 1)] for i in range(len(steps)))]
        self.down = nn.ModuleList(
            _convolution(a, b, _SIDES[step], step, 1)
            for (a, b), step in zip(pairwise(channels), steps, strict=True)
        )
        self.channels = channels[-1]
        self.mix = _convolution(self.channels, self.channels, 1)
        self.top = _convolution(self.channels, _TOP, 3, 2, 1)
        with torch.no_grad():
            places = self._map(torch.zeros(1, 3, *size, dtype=torch.float32))
            inputs = self.top(places).numel()
        self.grid = (int(places.shape[2]), int(places.shape[3]))
        self.project = linear(inputs, width)
        self.normalize = nn.LayerNorm(width, dtype=torch.float32)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def standardize(self, images: Tensor) -> None:
        """Take mean image and contrast from images (B, 3, H, W), on any device."""
        mean, variance = mean_and_variance(images)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def _map(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, channels, h, w)."""
        h = (images - self.mean) / self.std
        for layer in self.down:
            h = F.relu(layer(h))
        return h + F.relu(self.mix(h))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, places, channels) and vector (B, width)."""
        places = self._map(images.contiguous(memory_format=torch.channels_last))
        top = F.relu(self.top(places))
        vector = F.gelu(self.normalize(self.project(top.flatten(1))))
        return places.flatten(2).transpose(1, 2), vector


_convolution = partial(nn.Conv2d, dtype=torch.float32)  # whatever PyTorch's default is


def _steps(side: int) -> list[int]:
    """Strides of the convolutions that reduce a side to at most `_MAP_SIDE`; at least one."""
    steps = [4 if side >= _LARGE else 2]
    while side > _MAP_SIDE * math.prod(steps):
        steps.append(2)
    return steps


# -- densities on one axis -------------------------------------------------------------------------


NUMBERS = 4
"""That a network gives for each component."""

_SMALLEST, _LARGEST, _LARGEST_PERIODIC = 2e-3, 1.0, 0.5  # standard deviations
_OFFSET = 1.0  # so that a network that says 0 means about 0.2
_FREQUENCIES = (1.0, 2.0, 4.0, 8.0)
WAVES = 1 + 2 * len(_FREQUENCIES)
"""Numbers that `fourier` gives for each coordinate."""


@dataclass(frozen=True)
class Components:
    """Mixtures of Gaussians (..., d, K) on each of d axes, with all their mass in [0, 1].

    An integer or a choice needs nothing of its own: its cells are uniform in the cube, and so is
    its posterior within a cell.

        ordinary axis    sum_k w_k N(u; m_k, s_k) / (Phi((1 - m_k) / s_k) - Phi(-m_k / s_k))
        periodic axis    sum_k w_k sum_j N(u + j; m_k, s_k),  j = -1, 0, 1

    weight: their logarithms.
    mean, std: in units of the cube.  periodic: (d, 1), axes that wrap around.
    """

    weight: Tensor
    mean: Tensor
    std: Tensor
    periodic: Tensor

    @classmethod
    def of(cls, raw: Tensor, periodic: Tensor, scale: float = 1.0) -> Components:
        """Components of a network's numbers (..., d, K, 4), deviations times `scale`."""
        weight, first, second, spread = raw.unbind(-1)
        wraps = periodic[:, None]
        angle = torch.atan2(second, first + 1e-6) / (2 * math.pi)
        mean = torch.where(wraps, angle - angle.floor(), torch.sigmoid(first))
        largest = torch.where(wraps, _LARGEST_PERIODIC, _LARGEST).float()  # (d, 1)
        std = _SMALLEST * (largest / _SMALLEST) ** torch.sigmoid(spread + _OFFSET)
        if scale != 1.0:
            std = torch.minimum(std * scale, largest)  # what wraps stays within three turns
        return cls(F.log_softmax(weight, dim=-1), mean, std, wraps)

    def log_density(self, u: Tensor) -> Tensor:
        """Logarithm of each component's density (..., d, K), without its weight, at u (..., d)."""
        z = (u[..., None] - self.mean) / self.std
        peak = -self.std.log() - 0.5 * math.log(2 * math.pi)
        straight = peak - 0.5 * z.square() - self._mass().log()
        on_cpu = self.periodic.device.type == "cpu"  # a GPU would be waited for
        if on_cpu and not bool(self.periodic.any()):
            return straight
        around = torch.stack([(z + j / self.std).square() for j in (-1.0, 0.0, 1.0)])
        wrapped = peak + torch.logsumexp(-0.5 * around, dim=0)
        return torch.where(self.periodic, wrapped, straight)

    def log_mixture(self, u: Tensor) -> Tensor:
        """Logarithm of the density of each axis (..., d) at u (..., d)."""
        return torch.logsumexp(self.weight + self.log_density(u), dim=-1)

    def draw(self, generator: torch.Generator) -> Tensor:
        """Draw (..., d), each axis by itself."""
        flat = self.weight.exp().reshape(-1, self.weight.shape[-1])
        which = torch.multinomial(flat, 1, generator=generator).reshape(self.weight.shape[:-1])
        mean, std = (t.gather(-1, which[..., None])[..., 0] for t in (self.mean, self.std))
        low, high = _phi(-mean / std), _phi((1 - mean) / std)
        v = torch.rand(mean.shape, generator=generator, dtype=mean.dtype)
        p = (low + v * (high - low)).clamp(1e-6, 1 - 1e-6)
        quantile = math.sqrt(2) * torch.erfinv(2 * p - 1)
        straight = (mean + std * quantile).clamp(0.0, 1.0)
        around = mean + std * torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        return torch.where(self.periodic[:, 0], around - around.floor(), straight)

    def _mass(self) -> Tensor:
        """Of each Gaussian within [0, 1]."""
        inside = _phi((1 - self.mean) / self.std) - _phi(-self.mean / self.std)
        return inside.clamp_min(1e-6)


def fourier(u: Tensor, periodic: Tensor) -> Tensor:
    """What a network gets of coordinates u (..., d): waves of several lengths, (..., d, 9).

    periodic: (d,) bool; on these axes 0 and 1 give the same.
    """
    turns = 2 * math.pi * u[..., None] * u.new_tensor(_FREQUENCIES)
    line = torch.where(periodic, u.new_zeros(()), 2 * u - 1)
    return torch.cat([line[..., None], turns.cos(), turns.sin()], dim=-1)


def _phi(z: Tensor) -> Tensor:
    return 0.5 * (1 + torch.erf(z / math.sqrt(2)))


def split(features: Tensor, heads: int) -> Tensor:
    """Share of each head, (B, n, W) -> (B, heads, n, W / heads)."""
    return features.view(*features.shape[:2], heads, -1).transpose(1, 2)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """What queries (B, heads, m, w) find at n keys, by their values; (B, m, heads * w)."""
    return F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)


# -- densities of all parameters -------------------------------------------------------------------


# A head has
#
#     log_prob(places, vector, u, scale)             logarithm of the density (B,) at u (B, d)
#     sample(places, vector, n, generator, scale)    draws (n, d) of one picture
#
# Features are those of `Encoder`; those of one picture are features of all u.  scale: of all
# standard deviations, see `judging`.


class Autoregressive(nn.Module):
    """prod_i p(u_i | u_1 ... u_(i-1)), each a mixture of K Gaussians.

    RNADE, Uria, Murray and Larochelle 2013, arXiv:1306.0186.
    """

    periodic: Tensor
    before: Tensor

    def __init__(self, width: int, periodic: Tensor, components: int = 6, hidden: int = 96) -> None:
        super().__init__()
        d = len(periodic)
        self.components, self.hidden = components, hidden
        self.register_buffer("periodic", periodic, persistent=False)
        before = torch.ones(d, d, dtype=torch.float32).triu(1)  # 1 where the row comes before
        self.register_buffer("before", before, persistent=False)
        self.context = linear(width, d * hidden)
        self.earlier = nn.Parameter(_uniform_weights((d * WAVES, d * hidden), d * WAVES))
        self.second = nn.Parameter(_uniform_weights((d, hidden, hidden), hidden))
        self.out = nn.Parameter(_uniform_weights((d, hidden, components * NUMBERS), hidden))
        self.second_bias = nn.Parameter(torch.zeros(d, 1, hidden, dtype=torch.float32))
        self.out_bias = nn.Parameter(
            0.5 * torch.randn(d, 1, components * NUMBERS, dtype=torch.float32)
        )

    def _of(self, vector: Tensor, u: Tensor, scale: float) -> Components:
        """Components (B, d, K), those of u_i given features and the parameters before i."""
        d, hidden = len(self.periodic), self.hidden
        waves = fourier(u, self.periodic).flatten(1)  # (B, d * 9)
        earlier = self._earlier() * self.before[:, None, :, None]
        h = F.gelu(self.context(vector) + waves @ earlier.view_as(self.earlier))
        h = h.view(-1, d, hidden).transpose(0, 1)  # (d, B, hidden)
        h = F.gelu(torch.baddbmm(self.second_bias, h, self.second)) + h
        raw = torch.baddbmm(self.out_bias, h, self.out).transpose(0, 1)
        return self._components(raw, self.periodic, scale)

    def _of_one(self, i: int, context: Tensor, waves: Tensor, scale: float) -> Components:
        """Components (n, 1, K) of u_i; context: (d, hidden); waves: (n, i * 9)."""
        h = F.gelu(context[i] + waves @ self._earlier()[:i, :, i].flatten(0, 1))
        h = F.gelu(self.second_bias[i] + h @ self.second[i]) + h
        raw = self.out_bias[i] + h @ self.out[i]
        return self._components(raw, self.periodic[i : i + 1], scale)

    def _components(self, raw: Tensor, periodic: Tensor, scale: float) -> Components:
        """Components (B, d, K) of as many numbers as they need."""
        raw = raw.reshape(len(raw), len(periodic), self.components, NUMBERS)
        return Components.of(raw, periodic, scale)

    def _earlier(self) -> Tensor:
        """Weights (d, 9, d, hidden) from the waves of each parameter to the units of each."""
        d = len(self.periodic)
        return self.earlier.view(d, WAVES, d, self.hidden)

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor, scale: float) -> Tensor:
        """Logarithm of the density (B,) at u (B, d); of `Blocks` a lower bound."""
        density: Tensor = self._of(vector, u, scale).log_mixture(u)
        return density.sum(dim=-1)

    def sample(
        self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator, scale: float
    ) -> Tensor:
        """Draws (n, d) of one picture."""
        d, k = len(self.periodic), self.components
        context: Tensor = self.context(vector).view(d, self.hidden)
        u, waves = context.new_empty(n, d), context.new_empty(n, d, WAVES)
        # each step draws for all axes, so that a seed draws the same in every version
        zeros = context.new_zeros(n, d, k)
        found = Components(zeros, zeros + 0.5, zeros + 1, self.periodic[:, None])
        for i in range(d):
            one = self._of_one(i, context, waves[:, :i].flatten(1), scale)
            found.weight[:, i], found.mean[:, i], found.std[:, i] = (
                part[:, 0] for part in (one.weight, one.mean, one.std)
            )
            u[:, i] = found.draw(generator)[:, i]
            waves[:, i] = fourier(u[:, i : i + 1], self.periodic[i : i + 1])[:, 0]
        return u


def _uniform_weights(shape: tuple[int, ...], inputs: int) -> Tensor:
    drawn: Tensor = (2 * torch.rand(shape, dtype=torch.float32) - 1) / inputs**0.5
    return drawn


# -- exchangeable blocks as a set ------------------------------------------------------------------


_SET_WIDTH, _SET_HEADS, _SET_LAYERS = 96, 4, 3


class Blocks(nn.Module):
    """Queries for the exchangeable blocks (n, L), a set (Carion et al. 2020, arXiv:2005.12872).

    All other axes are learned by an `Autoregressive` head.
    """

    periodic: Tensor
    blocks: Tensor
    waves: Tensor

    def __init__(
        self, encoder: Encoder, width: int, periodic: Tensor, blocks: Sequence[Sequence[int]]
    ) -> None:
        super().__init__()
        index = torch.tensor([list(block) for block in blocks])  # (n, L)
        self.register_buffer("blocks", index, persistent=False)
        self.register_buffer("periodic", periodic[index[0]], persistent=False)
        others = [i for i in range(len(periodic)) if i not in set(index.flatten().tolist())]
        self.others, self.dim = others, len(periodic)
        self.rest = Autoregressive(width, periodic[others]) if others else None
        n, length = index.shape
        self.place_in = linear(encoder.channels, _SET_WIDTH)
        self.register_buffer("waves", waves_of(*encoder.grid, *encoder.grid), persistent=False)
        self.position = linear(self.waves.shape[1], _SET_WIDTH)
        self.query = nn.Parameter(torch.randn(n, _SET_WIDTH, dtype=torch.float32))
        self.layers = nn.ModuleList(_SetLayer() for _ in range(_SET_LAYERS))
        self.out = linear(_SET_WIDTH, length * NUMBERS)

    def _of(self, places: Tensor, scale: float) -> Components:
        """One component (B, n, L, 1) for each query."""
        seen = self.place_in(F.layer_norm(places, places.shape[-1:]))
        image = seen + self.position(self.waves)  # (B, places, W)
        h = self.query.expand(len(places), -1, -1)
        for layer in self.layers:
            h = layer(h, image)
        raw = self.out(F.layer_norm(h, h.shape[-1:]))
        raw = raw.view(len(places), len(self.blocks), -1, 1, NUMBERS)
        return Components.of(raw, self.periodic, scale)

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor, scale: float) -> Tensor:
        """Logarithm of the density (B,) at u (B, d); of `Blocks` a lower bound."""
        found = self._of(places, scale)
        mean, std = (t[:, :, None] for t in (found.mean, found.std))  # (B, n, 1, L, 1)
        pairs = Components(found.weight[:, :, None], mean, std, found.periodic)
        blocks = u[:, self.blocks][:, None]  # (B, 1, n, L)
        gain = pairs.log_mixture(blocks).sum(dim=-1)  # (B, queries, blocks)
        matched = gain.gather(2, _matching(gain)[..., None])[..., 0].sum(dim=-1)
        total = matched - math.lgamma(len(self.blocks) + 1)
        if self.rest is not None:
            total = total + self.rest.log_prob(places, vector, u[:, self.others], scale)
        return total

    def sample(
        self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator, scale: float
    ) -> Tensor:
        """Draws (n, d) of one picture."""
        found = self._of(places, scale)
        many = (n, *found.mean.shape[1:])
        weight, mean, std = (t.expand(many) for t in (found.weight, found.mean, found.std))
        u = torch.empty(n, self.dim, dtype=torch.float32)
        u[:, self.blocks] = Components(weight, mean, std, found.periodic).draw(generator)
        if self.rest is not None:
            u[:, self.others] = self.rest.sample(places, vector, n, generator, scale)
        return u


class _SetLayer(nn.Module):
    """Queries attend to each other and to the image; then each is transformed by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.among = _SetAttention()
        self.image = _SetAttention()
        self.inner = linear(_SET_WIDTH, 2 * _SET_WIDTH)
        self.outer = linear(2 * _SET_WIDTH, _SET_WIDTH)

    def forward(self, h: Tensor, image: Tensor) -> Tensor:
        """Queries (B, n, W), image (B, places, W) -> (B, n, W)."""
        normal = F.layer_norm(h, h.shape[-1:])
        h = h + self.among(normal, normal)
        h = h + self.image(F.layer_norm(h, h.shape[-1:]), image)
        inner = F.gelu(self.inner(F.layer_norm(h, h.shape[-1:])))
        out: Tensor = h + self.outer(inner)
        return out


class _SetAttention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.query = linear(_SET_WIDTH, _SET_WIDTH)
        self.key_value = linear(_SET_WIDTH, 2 * _SET_WIDTH)
        self.out = linear(_SET_WIDTH, _SET_WIDTH)

    def forward(self, h: Tensor, of: Tensor) -> Tensor:
        keys, values = self.key_value(of).chunk(2, dim=-1)
        q, k, v = (split(t, _SET_HEADS) for t in (self.query(h), keys, values))
        out: Tensor = self.out(attend(q, k, v))
        return out


def waves_of(h: int, w: int, height: float, width: float) -> Tensor:
    """Waves (h * w, 18) of the middles of h x w places of size 1 in that height and width."""
    y = (torch.arange(h, dtype=torch.float32) + 0.5) / height
    x = (torch.arange(w, dtype=torch.float32) + 0.5) / width
    return fourier(torch.cartesian_prod(y, x), torch.tensor([False, False])).flatten(1)


def _matching(gain: Tensor) -> Tensor:
    """Block (B, n) for each query by which the sum of gains (B, queries, blocks) is largest."""
    values = np.nan_to_num(gain.detach().cpu().numpy(), nan=-1e9, posinf=1e9, neginf=-1e9)
    found = [linear_sum_assignment(each, maximize=True)[1] for each in values]
    return torch.from_numpy(np.array(found, np.int64)).to(gain.device)


# -- the network -----------------------------------------------------------------------------------


_FEATURES = 256
Blocking = Sequence[Sequence[int]]


class Network(Trainable):
    """Density of the parameters given an image.

    size: (H, W).  periodic: (d,), axes that wrap around.  blocks: exchangeable ones, a set.
    seed: of the initial weights.  scale: of the standard deviations, see `judging`; no weight.
    """

    def __init__(
        self, size: tuple[int, int], periodic: Sequence[bool], blocks: Blocking = (), seed: int = 0
    ) -> None:
        super().__init__()
        self.size, self.dim, self.scale = size, len(periodic), 1.0
        self.periodic = tuple(bool(wraps) for wraps in periodic)
        self.blocks = tuple(tuple(int(axis) for axis in block) for block in blocks)
        with torch.random.fork_rng(devices=[]):  # the global generator stays as it was
            torch.default_generator.manual_seed(seed)
            self.encoder = Encoder(size, _FEATURES)
            wraps, encoder = torch.tensor(periodic), self.encoder
            self.head: Any = (
                Blocks(encoder, _FEATURES, wraps, blocks)
                if len(blocks)
                else Autoregressive(_FEATURES, wraps)
            )
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def log_prob(self, images: Tensor, u: Tensor) -> Tensor:
        """Logarithm of the density (B,) at u (B, d), given images (B, 3, H, W), or one for all."""
        places, vector = self.encoder(images)
        density: Tensor = self.head.log_prob(places, vector, u, self.scale)
        return density

    def standardize(self, images: Tensor) -> None:
        """Take mean image and contrast from images (B, 3, H, W), on any device."""
        self.encoder.standardize(images)

    def loss(self, images: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood in nats; nothing of it is drawn by the generator."""
        return -self.log_prob(images, u).mean()

    @torch.no_grad()
    def vectors(self, images: Tensor) -> Tensor:
        """Features (B, width) of images (B, 3, H, W)."""
        vector: Tensor = self.encoder(images)[1]
        return vector

    @torch.no_grad()
    def sample(self, image: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """Draw (n, d) given one image (1, 3, H, W)."""
        places, vector = self.encoder(image)
        drawn: Tensor = self.head.sample(places, vector, n, generator, self.scale)
        return drawn


def as_input(images: Pixels, device: torch.device | str = "cpu") -> Tensor:
    """Images (B, H, W, 3) uint8 as a network takes them, (B, 3, H, W) in [0, 1], on its device."""
    return torch.from_numpy(images).to(device).permute(0, 3, 1, 2).float() / 255
