"""Networks in batches of a fixed size, so that a result does not depend on the rest of the batch.

Matrix products of different shapes may sum in different orders.  With a variable batch size, the
last bits of an image's features would depend on the number of images in the batch, and a run on
the pieces in which results are told.

A single image costs as much as a full batch, so batches on a CPU are small.  With batches twice as
large, a small vision transformer would need an eighth less time for each 112 x 112 image, but
nearly twice the time for a single one.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["batch_size", "in_batches"]

_PIXELS = 2 * 112 * 112  # pixels of a batch on a CPU; larger batches are little faster
_ON_GPU = 64  # times as many pixels and images on a GPU
_MOST = 4  # most images of a batch on a CPU


def batch_size(device: torch.device, height: int, width: int) -> int:
    """Number of images of that size in a batch: on a CPU 2 images of 112 x 112."""
    more = 1 if device.type == "cpu" else _ON_GPU
    return min(max(more * _PIXELS // (height * width), 1), more * _MOST)


def in_batches(network: Callable[[Tensor], Tensor], images: Tensor, size: int) -> Tensor:
    """Results (n, ...) of a network for images (n, ...), in batches of exactly `size` images.

    The last batch is padded with zeros.
    """
    results = []
    for start in range(0, max(len(images), 1), size):
        piece = images[start : start + size]
        missing = size - len(piece)
        if missing:
            piece_of_size = torch.cat([piece, piece.new_zeros(missing, *piece.shape[1:])])
            results.append(network(piece_of_size)[: len(piece)])
        else:
            results.append(network(piece))
    return torch.cat(results)
