"""The parameter transformer of supplement S1; the class says what the paper leaves open."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fide_plugins.errors import OptionError

Context: TypeAlias = list[tuple[Tensor, Tensor]]
"""Keys and values of the image tokens, one pair a block, each [B or 1, heads, T, width / heads]."""

SMALLEST_NOISE = 1e-8  # keeps ln(s) finite for a parameter without noise


class Block(nn.Module):
    """Self-attention, cross-attention, perceptron; each with residual, LayerNorm and FiLM."""

    def __init__(self, width: int, heads: int, hidden: int, noise_width: int) -> None:
        super().__init__()
        self.heads = heads
        self.parts = 3 if hidden else 2
        self.film = nn.Linear(noise_width, 2 * self.parts * width)
        self.self_qkv = nn.Linear(width, 3 * width)
        self.self_out = nn.Linear(width, width)
        self.cross_q = nn.Linear(width, width)
        self.cross_kv = nn.Linear(width, 2 * width)
        self.cross_out = nn.Linear(width, width)
        self.mlp_in = nn.Linear(width, hidden) if hidden else None
        self.mlp_out = nn.Linear(hidden, width) if hidden else None

    def keys_values(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(B, T, width) -> keys and values (B, heads, T, width / heads)."""
        k, v = self.cross_kv(image).chunk(2, dim=-1)
        return self._split(k), self._split(v)

    def forward(self, h: Tensor, noise: Tensor, key_value: tuple[Tensor, Tensor]) -> Tensor:
        """(B, d, width) tokens -> (B, d, width)."""
        film = self.film(noise).chunk(2 * self.parts, dim=-1)  # scale, shift of each part
        h = h + self._attend_self(modulate(h, film[0], film[1]))
        h = h + self._attend_image(modulate(h, film[2], film[3]), *key_value)
        if self.mlp_in is not None and self.mlp_out is not None:
            h = h + self.mlp_out(F.gelu(self.mlp_in(modulate(h, film[4], film[5]))))
        return h

    def _attend_self(self, h: Tensor) -> Tensor:
        q, k, v = (self._split(part) for part in self.self_qkv(h).chunk(3, dim=-1))
        out: Tensor = self.self_out(merge(F.scaled_dot_product_attention(q, k, v)))
        return out

    def _attend_image(self, h: Tensor, k: Tensor, v: Tensor) -> Tensor:
        batch, n, width = h.shape
        q = self.cross_q(h)
        if k.shape[0] == 1:  # one image for all: queries do not interact, so fold them together
            q = q.reshape(1, batch * n, width)
        attended = merge(F.scaled_dot_product_attention(self._split(q), k, v))
        out: Tensor = self.cross_out(attended.reshape(batch, n, width))
        return out

    def _split(self, h: Tensor) -> Tensor:
        """(B, n, width) -> (B, heads, n, width / heads)."""
        return h.view(*h.shape[:2], self.heads, -1).transpose(1, 2)


class ParameterTransformer(nn.Module):
    """Supplement S1's network: noisy parameters and an image's tokens to parameters.

    Image tokens are projected to the network's width and get learned positions; with the `patch`
    encoder this *is* the paper's learnable patch embedding.  A dense linear layer turns the noisy
    parameters into one token each.  Each of four blocks has self-attention among these,
    cross-attention to the image tokens and a two-layer perceptron, scaled and shifted (FiLM) by the
    noise level of its own parameter.  The tokens are concatenated and projected to the parameters.

    What the paper leaves open: width 64 and 4 heads, small enough for 500 examples and a CPU; the
    perceptron, of twice the width, without which nothing between the attention layers is
    non-linear (`mlp_ratio=0` removes it); pre-normalization, where FiLM replaces gain and offset;
    noise enters as ln(s) / 4 (Karras et al. 2022) and s, through one hidden layer.

    Parameters
    ----------
    dim, image_tokens, channels : d, T, and C of an image token; all sizes are at least 1.
    generator : draws the initial weights, on the CPU, whatever the device the network moves to.
    width, heads, blocks, mlp_ratio, noise_width : sizes; `width` is a multiple of `heads`.
    """

    def __init__(
        self,
        dim: int,
        image_tokens: int,
        channels: int,
        *,
        generator: torch.Generator,
        width: int = 64,
        heads: int = 4,
        blocks: int = 4,
        mlp_ratio: int = 2,
        noise_width: int = 32,
    ) -> None:
        sizes = dim, image_tokens, channels, width, heads, blocks, noise_width
        if min(sizes) < 1 or width % heads:
            raise OptionError(
                "sizes of a denoiser are at least 1, and width is a multiple of heads; got "
                f"{dim=}, {image_tokens=}, {channels=}, {width=}, {heads=}, {blocks=}"
            )
        super().__init__()
        self.dim, self.width = dim, width
        self.image_tokens, self.channels = image_tokens, channels
        with torch.device("meta"):  # no weights yet, so the global generator is not touched
            self.image_in = nn.Linear(channels, width)
            self.position = nn.Parameter(torch.empty(image_tokens, width))
            self.noise_in = nn.Linear(2, noise_width)
            self.parameter_in = nn.Linear(dim, dim * width)
            self.blocks = nn.ModuleList(
                Block(width, heads, mlp_ratio * width, noise_width) for _ in range(blocks)
            )
            self.parameter_out = nn.Linear(dim * width, dim)
        self.float().to_empty(device="cpu")  # whatever PyTorch's default is
        self._initialize(generator)

    @torch.no_grad()
    def _initialize(self, generator: torch.Generator) -> None:
        """Uniform in +-1/sqrt(inputs) for every linear layer, N(0, 0.02) for positions."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = 1 / math.sqrt(module.in_features)
                module.weight.uniform_(-bound, bound, generator=generator)
                module.bias.uniform_(-bound, bound, generator=generator)
        self.position.normal_(0, 0.02, generator=generator)

    def encode_context(self, tokens: Tensor) -> Context:
        """Image tokens (B, T, C) -> keys and values of every block.

        The result for a single image (B = 1) serves any number of z.
        """
        image = self.image_in(tokens) + self.position  # (B, T, width)
        return [block.keys_values(image) for block in self._blocks()]

    def forward(self, z: Tensor, s: Tensor, context: Context) -> Tensor:
        """Noisy parameters z (B, d), their noise s (B, d), an image's context -> (B, d)."""
        level = torch.stack([s.clamp_min(SMALLEST_NOISE).log() / 4, s], dim=-1)  # (B, d, 2)
        noise = F.silu(self.noise_in(level))  # (B, d, noise_width)
        h = self.parameter_in(z).view(-1, self.dim, self.width)  # (B, d, width)
        for block, key_value in zip(self._blocks(), context, strict=True):
            h = block(h, noise, key_value)
        out: Tensor = self.parameter_out(h.flatten(1))
        return out

    def _blocks(self) -> list[Block]:
        return [block for block in self.blocks if isinstance(block, Block)]


def modulate(h: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """FiLM (Perez et al. 2018) of the normalized tokens."""
    return F.layer_norm(h, h.shape[-1:]) * (1 + scale) + shift


def merge(h: Tensor) -> Tensor:
    """(B, heads, n, width / heads) -> (B, n, width)."""
    return h.transpose(1, 2).flatten(2)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """Context of products in float32, whatever the autocast state of the calling thread."""
    return torch.autocast(device.type, torch.bfloat16, enabled=False, cache_enabled=False)
