"""Which parameters change the same places of the image: parameter groups by sensitivity samples.

Each parameter of the incumbent is moved, alone, to a random value: one render each. The overlap of
what they change says which parameters form a group (`find_parts`). What belongs together
depends on the renderer more than on the candidate: one round serves for all incumbents.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.spatial.distance import squareform

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import array, check, whole
from fide_plugins.search.scene.axes import Axes
from fide_plugins.search.scene.removal import changed
from fide_plugins.types import Float64, Indices

__all__ = ["Sensitivity", "find_parts", "overlaps"]


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


class Sensitivity:
    """Overlaps (p, p) of what p parameters change, averaged over rounds.

    dim: d.  channels: leading channels of the tokens in which changes are seen; None: all.
    axes: those of one parameter, such as a choice, are moved together; None: each is a parameter.
    """

    def __init__(self, dim: int, channels: int | None, axes: Axes | None = None) -> None:
        self.dim, self.channels = dim, channels
        self._axes = axes or Axes(dim)
        p = len(self._axes.axes_of)
        self.rounds = 0
        self._overlap = np.zeros((p, p))  # sum over all samples
        self._pairs = np.zeros((p, p))  # how often each pair was seen together

    def draw(self, x: Float64, rng: np.random.Generator) -> Float64:
        """Copies (p, d) of x (d,), each with one parameter at a random value."""
        samples = np.tile(x, (len(self._axes.axes_of), 1))
        samples[self._axes.parameter_of, np.arange(self.dim)] = rng.random(self.dim)
        return samples

    def learn(self, incumbent: TrainingSample, samples: Sequence[TrainingSample]) -> None:
        """Learn from renders of what `draw` gave; others, and missing ones, do no harm."""
        parameter_of = self._axes.parameter_of
        moved = [np.unique(parameter_of[sample.x != incumbent.x]) for sample in samples]
        single = [(int(m[0]), s) for m, s in zip(moved, samples, strict=True) if len(m) == 1]
        self.rounds += 1
        if not single:
            return
        which = np.array([i for i, _ in single])
        changes = [changed(incumbent.tokens, s.tokens, self.channels) for _, s in single]
        self._overlap, self._pairs = self._overlap.copy(), self._pairs.copy()
        np.add.at(self._overlap, np.ix_(which, which), overlaps(np.array(changes)))
        np.add.at(self._pairs, np.ix_(which, which), 1.0)

    @property
    def groups(self) -> list[Indices]:
        """Axes of parameters that belong together, as far as is known."""
        parts = find_parts(self._overlap / np.maximum(self._pairs, 1.0))
        return [np.concatenate([self._axes.axes_of[i] for i in part]) for part in parts]

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"rounds": self.rounds, "overlap": self._overlap, "pairs": self._pairs}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        square = array("p", "p", low=0.0)
        form = {"rounds": whole(), "overlap": square, "pairs": square}
        check(state, form, {"p": len(self._axes.axes_of)}, "sensitivity")  # type: ignore[arg-type]
        self.rounds = state["rounds"]
        self._overlap, self._pairs = state["overlap"], state["pairs"]
