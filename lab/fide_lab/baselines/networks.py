"""Networks whose first weights come from a generator, and not from PyTorch's global one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch import nn

__all__ = ["load_weights", "make"]

M = TypeVar("M", bound=nn.Module)


def make(
    build: Callable[[], M],
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> M:
    """Module that `build` describes, of linear layers and layer norms, with PyTorch's usual law.

    Weights and offsets of a linear layer: uniform in +-1 / sqrt(inputs).
    """
    with torch.device("meta"):
        module = build()
    module.to_empty(device="cpu")
    with torch.no_grad():
        for part in module.modules():
            if isinstance(part, nn.Linear):
                bound = part.in_features**-0.5
                part.weight.uniform_(-bound, bound, generator=generator)
                part.bias.uniform_(-bound, bound, generator=generator)
            elif isinstance(part, nn.LayerNorm):
                part.reset_parameters()
    return module.to(device, dtype)


def load_weights(module: nn.Module, weights: Mapping[str, Any]) -> None:
    """Put back what ``module.state_dict()`` gave, be it tensors or arrays."""
    module.load_state_dict({key: torch.as_tensor(value) for key, value in weights.items()})
