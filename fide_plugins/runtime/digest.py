"""Which weights a network has, in a few digits: results of others are not comparable."""

from __future__ import annotations

import hashlib

import torch
from torch import nn

__all__ = ["digest"]


def digest(*networks: nn.Module, extra: object = "") -> str:
    """Eight hexadecimal digits that identify the weights.

    extra: other settings that change the results, hashed as `str`.
    """
    sha = hashlib.sha256(str(extra).encode())
    for network in networks:
        for key, value in sorted(network.state_dict().items()):
            sha.update(key.encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            sha.update(flat.view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()[:8]
