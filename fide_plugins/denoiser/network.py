"""The parameter transformer of supplement S1.

Image tokens are projected to the network's width and get learned positions.  (With the `patch`
encoder, whose tokens are the raw pixels of a patch, this projection *is* the paper's learnable
patch embedding.)  A linear layer turns the noisy parameters into one token each.  Four blocks
follow: self-attention among the parameter tokens, cross-attention to the image tokens, and a
two-layer perceptron, each scaled and shifted (FiLM) by the noise level of its own parameter.
The tokens are concatenated and projected to the parameters.

Choices that the paper leaves open
----------------------------------
- Width 64, 4 heads: small enough for 500 examples and a CPU.
- Number of parameter tokens: d ("quadratic self-attention over the parameters").  The linear
  layer is dense, so token i depends on all of z; it also gets the noise of parameter i.
  With n < d tokens (`parameter_tokens`) a token represents d / n neighboring parameters and gets
  their mean noise; the cost of a block then grows with n instead of d.
- "Four self-attention blocks followed by cross-attention": each block has both.
- Perceptron: S1 names none, but the transformer blocks it builds on have one, and without it
  nothing between the attention layers is non-linear.  Hidden width = 2 * width; `mlp_ratio=0`
  removes it.
- Pre-normalization; FiLM replaces gain and offset of the LayerNorm.
- Noise enters as ln(s) / 4 (Karras et al. 2022) and s, through one hidden layer.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fide_plugins.errors import OptionError
from fide_plugins.runtime.devices import has_bfloat16
from fide_plugins.runtime.messages import warn_user

__all__ = ["PRECISIONS", "Context", "ParameterTransformer", "autocast", "check_precision"]

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

    Parameters
    ----------
    dim : d, the number of parameters.
    image_tokens : T, the number of tokens of an image.
    parameter_tokens : n, tokens of the parameters; None: d, one each, as published.
    channels : C, the channels of a token.
    generator : draws the initial weights, on the CPU, whatever the device the network moves to.
    width, heads, blocks, mlp_ratio : see the module's text.

    Raises
    ------
    OptionError
        if a size is not positive or `width` is no multiple of `heads`.
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
        parameter_tokens: int | None = None,
        mlp_ratio: int = 2,
        noise_width: int = 32,
    ) -> None:
        sizes = {"dim": dim, "image_tokens": image_tokens, "channels": channels, "width": width}
        sizes |= {"heads": heads, "blocks": blocks, "noise_width": noise_width}
        n = dim if parameter_tokens is None else min(parameter_tokens, dim)
        sizes |= {"parameter_tokens": n}
        for name, size in sizes.items():
            if size < 1:
                raise OptionError(f"{name} of a denoiser is at least 1, got {size}")
        if width % heads:
            raise OptionError(f"width is a multiple of heads, got {width=} and {heads=}")
        super().__init__()
        self.dim, self.width, self.parameter_tokens = dim, width, n
        self.image_tokens, self.channels = image_tokens, channels
        with torch.device("meta"):  # no weights yet, so the global generator is not touched
            self.image_in = nn.Linear(channels, width)
            self.position = nn.Parameter(torch.empty(image_tokens, width))
            self.noise_in = nn.Linear(2, noise_width)
            self.parameter_in = nn.Linear(dim, n * width)
            self.blocks = nn.ModuleList(
                Block(width, heads, mlp_ratio * width, noise_width) for _ in range(blocks)
            )
            self.parameter_out = nn.Linear(n * width, dim)
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
        if self.parameter_tokens < self.dim:  # each token gets the mean noise of its parameters
            means = F.adaptive_avg_pool1d(level.transpose(1, 2), self.parameter_tokens)
            level = means.transpose(1, 2)  # (B, n, 2)
        noise = F.silu(self.noise_in(level))  # (B, n, noise_width)
        h = self.parameter_in(z).view(-1, self.parameter_tokens, self.width)  # (B, n, width)
        for block, key_value in zip(self._blocks(), context, strict=True):
            h = block(h, noise, key_value)
        out: Tensor = self.parameter_out(h.flatten(1))
        return out.to(z.dtype)  # back to single precision if the products were in bfloat16

    def _blocks(self) -> list[Block]:
        return [block for block in self.blocks if isinstance(block, Block)]


def modulate(h: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """FiLM (Perez et al. 2018) of the normalized tokens."""
    return F.layer_norm(h, h.shape[-1:]) * (1 + scale) + shift


def merge(h: Tensor) -> Tensor:
    """(B, heads, n, width / heads) -> (B, n, width)."""
    return h.transpose(1, 2).flatten(2)


PRECISIONS = ("float32", "bfloat16")


def check_precision(precision: str, device: torch.device) -> str:
    """Precision for the device: float32, with a RuntimeWarning, if it does not support bfloat16.

    Raises OptionError for a name that is not in `PRECISIONS`.
    """
    if precision not in PRECISIONS:
        raise OptionError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}")
    if precision == "bfloat16" and not has_bfloat16(device):
        warn_user(
            f"this {device.type} does not support precision='bfloat16' in hardware; float32 is "
            "used instead"
        )
        return "float32"
    return precision


def autocast(precision: str, device: torch.device) -> AbstractContextManager[object]:
    """Context that computes products in this precision, and sensitive sums in float32.

    It does not depend on the autocast state of the calling thread, which other threads do not
    share.  It caches no copies of weights, which would outlive a training step in an outer block.
    """
    low = precision == "bfloat16"
    return torch.autocast(device.type, torch.bfloat16, enabled=low, cache_enabled=False)
