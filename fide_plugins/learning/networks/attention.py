"""Attention by several heads: each attends by its own share of the features."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

__all__ = ["attend", "split"]


def split(features: Tensor, heads: int) -> Tensor:
    """Share of each head, (B, n, W) -> (B, heads, n, W / heads)."""
    return features.view(*features.shape[:2], heads, -1).transpose(1, 2)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """What queries (B, heads, m, w) find at n keys, by their values; (B, m, heads * w)."""
    return F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
