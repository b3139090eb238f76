"""Which parameters belong together, found from what they change in the image.

A cell, a bead, a limb, a camera: the parameters of one thing change the same places of the picture,
those of different things different places.  Seen are *changes* A (n, T): row i says how much each
of T patches of the image changed when parameter i alone was moved.  Two parameters are alike by the
overlap coefficient (Simpson 1943; Vijaymeena and Kavitha 2016, eq. 7) of their rows,

    O_ij = sum_t min(A_it, A_jt) / min(sum_t A_it, sum_t A_jt),

which is 1 when what the weaker one changes, the stronger one changes too: a color changes the
whole cell, a coordinate its border only.

Parts are read from a dendrogram of 1 - O by the excess of mass, as clusters are in HDBSCAN
(Campello et al. 2015, "Hierarchical Density Estimates for Data Clustering", sec. 5): a branch is
one part if it lasts longer, from the height at which it forms to the height at which it joins
another, than its own branches do together.  So neither their number nor a threshold is asked for.
All parameters together are never one part: moving them all is what a restart does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.spatial.distance import squareform

from fide_plugins.types import Float64, Indices

__all__ = ["find_parts", "overlaps"]

_SIZE_POWER = 1.5  # of the number of parameters in the worth of a branch; measured


def overlaps(changes: Float64) -> Float64:
    """O (n, n) of changes (n, T) >= 0; a parameter that changes nothing overlaps with nothing."""
    total = changes.sum(axis=1)
    shared = np.array([np.minimum(row, changes).sum(axis=1) for row in changes])
    smaller = np.minimum(total[:, None], total)
    overlap: Float64 = np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)
    return np.clip(overlap, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class _Branch:
    """A node of the dendrogram: its members, the height at which it forms, its best division."""

    members: list[int]
    height: float
    parts: list[list[int]]
    worth: float

    def closed(self, joins_at: float) -> _Branch:
        """Return the branch when it is known where it ends: one part, if that is worth as much."""
        whole = max(joins_at - self.height, 0.0) * len(self.members) ** _SIZE_POWER
        if whole < self.worth:
            return self
        return _Branch(self.members, self.height, [self.members], whole)


def find_parts(overlap: Float64) -> list[Indices]:
    """Divide n parameters into parts, each an array of indices, by their overlap (n, n)."""
    n = len(overlap)
    branches = [_Branch([i], 0.0, [[i]], 0.0) for i in range(n)]
    if n == 1:
        return [np.array([0])]
    distance = 1.0 - (overlap + overlap.T) / 2
    np.fill_diagonal(distance, 0.0)
    for a, b, height, _ in linkage(squareform(distance, checks=False), "average"):
        left, right = branches[int(a)].closed(height), branches[int(b)].closed(height)
        branches.append(
            _Branch(
                left.members + right.members,
                height,
                left.parts + right.parts,
                left.worth + right.worth,
            )
        )
    return [np.array(sorted(part)) for part in branches[-1].parts]
