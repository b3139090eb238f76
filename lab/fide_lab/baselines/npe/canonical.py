"""One order of exchangeable things, so that a network has no order to learn."""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64, Indices

__all__ = ["canonical"]


def canonical(X: Float64, blocks: Indices | None) -> Float64:
    """Points (n, d) with their exchangeable blocks in ascending order of their values.

    blocks: (m, L), the L parameters of each block; None: there are none.  Blocks are ordered by
        their first parameter; where it is equal, by the second, and so on.
    """
    if blocks is None:
        return X
    things = X[:, blocks]  # (n, m, L)
    keys = np.moveaxis(things, 2, 0)[::-1]  # the last key is the most important one
    order = np.lexsort(keys, axis=1)  # (n, m)
    ordered = X.copy()
    ordered[:, blocks] = np.take_along_axis(things, order[:, :, None], axis=1)
    return ordered
