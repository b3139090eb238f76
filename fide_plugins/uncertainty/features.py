"""Features of samples as numbers, and as few of them as say the same."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from fide_plugins.types import Float64

__all__ = ["compressed", "features_of", "floored", "independent"]

_DIGITS = 6  # of a feature, in single precision


def features_of(tokens: Sequence[Tensor], channels: int | None) -> Float64:
    """(n, f), of n times tokens (T, C); so many leading channels count, None: all."""
    rows = [one.detach()[..., :channels].cpu().numpy().ravel() for one in tokens]
    return np.array(rows, np.float64)


def compressed(e: Float64, target: Float64) -> tuple[Float64, Float64]:
    """Features (n, f) and those of the target (f,), turned into the few directions they span."""
    if e.shape[1] <= 2 * (len(e) + 1):
        return e, target
    both = np.vstack([e, target])
    rows: Float64 = np.asarray(np.linalg.qr(both.T, mode="r")).T  # their products are the same
    return rows[:-1], rows[-1]


def floored(distances: Float64) -> Float64:
    """Squared distances (n,); that of the solution from itself as small as the next one."""
    moved = distances[distances > 0]
    return np.maximum(distances, moved.min() if len(moved) else 1.0)


def independent(target: Float64, tokens: int, features: Float64) -> int:
    """How many features of the target (f,), so many tokens, are independent, at least one.

    Channels that are equal in all tokens count once, but never less than a third of them: a gray
    picture has three equal colors, and its noise is the same in each.  Tokens that equal the
    target's in all samples do not count: a mask hides them.

    features: (n, f), of samples.
    """
    channels = np.round(target.reshape(tokens, -1).T, _DIGITS)
    different = max(len(np.unique(channels, axis=0)), math.ceil(len(channels) / 3))
    apart = np.abs(features - target).max(axis=0)
    shown = (apart.reshape(tokens, -1) > 10**-_DIGITS).any(axis=1)
    return max(1, int(shown.sum())) * different
