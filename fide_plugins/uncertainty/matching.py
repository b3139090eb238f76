"""The exchangeable blocks of samples, in the order of those of a solution."""

from __future__ import annotations

import numpy as np

from fide_plugins.search.scene.axes import Axes
from fide_plugins.types import Float64, Indices, Mask

__all__ = ["aligned"]

_NUMBERS = 2**22  # differences of blocks that are held at once


def aligned(
    points: Float64, x: Float64, blocks: Indices | None, axes: Axes
) -> tuple[Float64, Mask]:
    """Points (n, d) with their blocks in the order of those of x (d,); which could be matched.

    Each block of a point belongs to the nearest one of x; it can be matched if they all differ.
    """
    if blocks is None:
        return points, np.ones(len(points), bool)
    step = max(1, _NUMBERS // (blocks.size * len(blocks)))
    chunks = [points[i : i + step] for i in range(0, len(points), step)]
    parts = [_aligned(chunk, x, blocks, axes) for chunk in chunks]
    return np.concatenate([p for p, _ in parts]), np.concatenate([kept for _, kept in parts])


def _aligned(points: Float64, x: Float64, blocks: Indices, axes: Axes) -> tuple[Float64, Mask]:
    """As `aligned`, of as many points as memory holds."""
    own = points[:, blocks]  # (n, blocks, L)
    costs = axes.difference(own[:, :, None], x[blocks], blocks).max(axis=3)  # (n, own, of x)
    places = costs.argmin(axis=2)  # (n, own)
    which: Mask = (np.sort(places, axis=1) == np.arange(len(blocks))).all(axis=1)
    sources = np.argsort(places, axis=1)[..., None]  # the block that belongs to each of x
    ordered = points.copy()
    ordered[:, blocks] = np.take_along_axis(own, sources, axis=1)
    return np.where(which[:, None], ordered, points), which
