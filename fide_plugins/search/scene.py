"""What has been found out about the scene: its parameters, and its local optima (`moves.Known`).

Nothing in this module knows a move.  `search.exchangeability` finds exchangeable blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np
from torch import Tensor, device

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import (
    Schema,
    Sides,
    Stateful,
    array,
    check,
    each,
    form,
    row,
    whole,
)
from fide_plugins.search import mixed
from fide_plugins.search.mixed import periodic_axes
from fide_plugins.space.layout import Layout
from fide_plugins.types import Float64, Indices


class Axes:
    """Which axes of the cube are one parameter, and which wrap around.

    A choice of n > 2 values has n axes, of which the largest coordinate decides: moved alone, they
    mostly change nothing, so moves move them together.

    dim: d.  layout: what is discrete or periodic; None: nothing.
    parameter_of: (d,), number of the parameter of each axis, from 0.
    axes_of: axes of each parameter.
    """

    def __init__(self, dim: int, layout: Layout | None = None) -> None:
        self.dim = dim
        self.periodic = periodic_axes(layout)
        first: Indices = np.arange(dim)  # axis of the parameter of each axis
        for block in () if layout is None else layout.choices:
            first[block] = block.start
        self.parameter_of: Indices = np.unique(first, return_inverse=True)[1]
        numbers = range(self.parameter_of[-1] + 1)
        self.axes_of = [np.flatnonzero(self.parameter_of == i) for i in numbers]

    def together(self, chosen: Indices) -> Indices:
        """All axes of the parameters that these axes are of."""
        if len(self.axes_of) == self.dim:
            return chosen
        return np.flatnonzero(np.isin(self.parameter_of, self.parameter_of[chosen]))

    def whole(self, blocks: Indices) -> bool:
        """Whether no parameter has axes in a block (one row each) and outside of it."""
        return all(len(self.together(block)) == len(block) for block in blocks)

    def difference(self, x: Float64, y: Float64, which: Indices | None = None) -> Float64:
        """Differences of coordinates x and y (..., d), the shorter way around; at least 0.

        which: axes (..., m) of coordinates x and y (..., m); None: all.
        """
        periodic = self.periodic
        return mixed.distance(
            x, y, periodic if periodic is None or which is None else periodic[which]
        )

    def inside(self, x: Float64) -> Float64:
        """Points (..., d) of the cube: periodic axes are wrapped, all others are clipped."""
        return mixed.inside(x, self.periodic)


# -- integers and choices --------------------------------------------------------------------------

_REMEMBERED = 200  # combinations
_CELLS_AWAY = (*range(2, 9), *(2**i for i in range(4, 10)))
_BEYOND = 1e-9  # beyond an edge, and in the next cell


class Values(Stateful):
    """Which other values integers and choices can have, and which combinations were searched.

    axes: those of one parameter.  layout: what is discrete in the cube.  None: nothing is.
    discrete: (d,), axes on which many points stand for one value.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {"searched": array("m", "discrete", low=0.0, high=1.0)}

    def __init__(self, axes: Axes | None = None, layout: Layout | None = None) -> None:
        self._axes, self._layout = axes, layout
        self.discrete = np.zeros(1, bool) if layout is None else layout.discrete
        self.forget()

    def forget(self) -> None:
        """Begin again, for another target."""
        self._searched = np.empty((0, int(self.discrete.sum())))  # the oldest first

    def others(self, x: Float64) -> Float64:
        """Copies (n, d) of a rendered point x (d,), each with another value of one parameter.

        All values of a choice; of an integer those up to 8 cells away, and 16, 32, ... 512.
        """
        if self._layout is None or self._axes is None:
            return np.empty((0, len(x)))
        parameters = [axes for axes in self._axes.axes_of if self.discrete[axes[0]]]
        rows = [row for axes in parameters for row in self._changed(x, axes)]
        every = self._layout.snap(np.array(rows).reshape(-1, len(x)))
        every = every[(every != x).any(axis=1)]
        distinct: Float64 = every[np.sort(np.unique(every, axis=0, return_index=True)[1])]
        return distinct

    def _changed(self, x: Float64, axes: Indices) -> Float64:
        """Copies (m, d) of x with coordinates of one parameter changed, x itself among them."""
        if len(axes) > 1:
            rows = np.tile(x, (len(axes), 1))
            rows[:, axes] = np.eye(len(axes))
            return rows
        assert self._layout is not None
        (i,) = axes
        edges = [float(edge[i]) for edge in self._layout.cells(x) if np.isfinite(edge[i])]
        values = [edge + np.copysign(_BEYOND, edge - x[i]) for edge in edges]
        width = 2 * min((abs(edge - x[i]) for edge in edges), default=1.0)
        values += [v for n in _CELLS_AWAY for v in (x[i] - n * width, x[i] + n * width)]
        values = [v for v in values if 0 <= v <= 1]
        rows = np.tile(x, (len(values), 1))
        rows[:, i] = values
        return rows

    def searches(self, X: Float64) -> Indices:
        """How often a search began at the values of each point (n, d), (n,)."""
        same = X[:, None, self.discrete] == self._searched
        return np.asarray(same.all(axis=2).sum(axis=1), np.intp)

    def note(self, x: Float64) -> None:
        """Note that a search begins at the values of x (d,)."""
        self._searched = np.vstack([self._searched, x[self.discrete]])[-_REMEMBERED:]

    def _sides(self) -> Sides:
        return {"discrete": int(self.discrete.sum())}


# -- blocks and groups of parameters ---------------------------------------------------------------

_LARGEST_COST = 1e300


class Removal(Stateful):
    """What each exchangeable block of one incumbent contributes to the image; one render a block.

    Block i is overwritten by a copy of another block.  Where blocks are exchangeable, and two in
    one place look like one, that deletes block i: the loss that it costs is its *removal cost*, and
    the tokens that change are the region that it *owns*.

    costs: (n,).  owned: (n, T); both are empty before a round.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "costs": array("blocks"),
        "owned": array("blocks", "tokens", low=0.0),
    }

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin again, for another incumbent."""
        self.costs: Float64 = np.empty(0)
        self.owned: Float64 = np.empty((0, 0))

    @property
    def known(self) -> bool:
        """Whether there was a round for the incumbent."""
        return len(self.costs) > 0

    def draw(self, x: Float64, blocks: Indices, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of x (d,), each with one block overwritten by another one."""
        n = len(blocks)
        other = (np.arange(n) + rng.integers(1, n, size=n)) % n
        removed = np.tile(x, (n, 1))
        for one, block, copied in zip(removed, blocks, blocks[other], strict=True):
            one[block] = x[copied]
        return removed

    def learn(
        self,
        incumbent: TrainingSample,
        samples: Sequence[TrainingSample],
        blocks: Indices,
        channels: int | None,
    ) -> None:
        """Learn from renders of what `draw` gave; a block without one costs nothing."""
        self.costs = np.zeros(len(blocks))
        self.owned = np.zeros((len(blocks), len(incumbent.tokens)))
        for sample in samples:
            moved = sample.x != incumbent.x
            touched = np.flatnonzero(moved[blocks].any(axis=1))
            if len(touched) == 1 and moved.sum() == moved[blocks[touched[0]]].sum():
                cost = np.clip(sample.loss - incumbent.loss, -_LARGEST_COST, _LARGEST_COST)
                self.costs[touched[0]] = cost
                self.owned[touched[0]] = changed(incumbent.tokens, sample.tokens, channels)

    def residual(self, incumbent: TrainingSample, target: Tensor, channels: int | None) -> Float64:
        """Squared error of the image in the tokens that each block owns, (n,)."""
        error = changed(incumbent.tokens, target, channels) ** 2  # (T,)
        part = self.owned**2
        part = part / np.maximum(part.sum(axis=0), 1e-300)
        owned: Float64 = part @ error
        return owned


def changed(before: Tensor, after: Tensor, channels: int | None) -> Float64:
    """How much each of the T tokens differs, (T,), Euclidean."""
    difference = (after.to(before.device) - before)[:, :channels].double()
    return np.asarray(difference.square().sum(dim=1).sqrt().cpu().numpy(), np.float64)


_SIZE_POWER = 1.5  # of the number of parameters in the worth of a branch; measured


def overlaps(changes: Float64) -> Float64:
    """Overlap coefficients (n, n) (Simpson 1943) of changes (n, T) >= 0.

    O_ij = sum_t min(A_it, A_jt) / min(sum_t A_it, sum_t A_jt) is 1 when what the weaker one
    changes, the stronger one changes too: a color changes the whole cell, a coordinate its border
    only.  A parameter that changes nothing overlaps with nothing.
    """
    total = changes.sum(axis=1)
    shared = np.array([np.minimum(one, changes).sum(axis=1) for one in changes])
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
    """Divide n parameters into parts, each an array of indices, by their overlap (n, n).

    Parts are read from a dendrogram of 1 - O by the excess of mass, as in HDBSCAN (Campello et al.
    2015, sec. 5): a branch is one part if it lasts longer, from the height at which it forms to the
    height at which it joins another, than its own branches do together.  All parameters together
    are never one part: moving them all is what a restart does.
    """
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    n = len(overlap)
    branches = [_Branch([i], 0.0, [[i]], 0.0) for i in range(n)]
    if n == 1:
        return [np.array([0])]
    distance = 1.0 - (overlap + overlap.T) / 2
    np.fill_diagonal(distance, 0.0)
    for a, b, height, _ in linkage(squareform(distance, checks=False), "average"):
        left, right = branches[int(a)].closed(height), branches[int(b)].closed(height)
        members, parts = left.members + right.members, left.parts + right.parts
        branches.append(_Branch(members, height, parts, left.worth + right.worth))
    return [np.array(sorted(part)) for part in branches[-1].parts]


class Sensitivity(Stateful):
    """Groups of parameters that change the same places of the image.

    Each parameter of the incumbent is moved, alone, to a random value: one render each.  The
    overlap of what they change says which form a group.  That depends on the renderer more than on
    the candidate: one round serves for all incumbents.

    dim: d.  channels: leading channels of the tokens in which changes are seen; None: all.
    axes: those of one parameter, such as a choice, are moved together; None: each is a parameter.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "rounds": whole(),
        "overlap": array("p", "p", low=0.0),
        "pairs": array("p", "p", low=0.0),
    }

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

    def _sides(self) -> Sides:
        return {"p": len(self._axes.axes_of)}


# -- local optima ----------------------------------------------------------------------------------

Distance: TypeAlias = Callable[[Float64, Float64], float]

_MOST = 12  # optima that are remembered
APART = 0.05  # of the unit cube, in some parameter, that makes two optima distinct
_NEW, _NEW_AGAIN = 1.0, 0.5  # score of the first new search; added by each without a success


@dataclass(slots=True)
class Optimum:
    """A local optimum.

    failures: of moves from it.
    searches: that ended there and had begun apart from it; no move is chosen by them.
    refined: whether `refine` was tried.
    """

    sample: TrainingSample
    failures: int = 0
    searches: int = 1
    refined: bool = False


class Optima:
    """Distinct local optima, best first, and how often moves from each of them failed.

    The next incumbent is the optimum with the lowest *score*, its rank by loss plus its failures in
    units of a tolerance.  A new search is due when its own score is lower still.

    forgotten: searches that ended in places which are no longer remembered.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "samples": each(form(TrainingSample)),
        "counts": each(row(whole(), whole(), whole(high=1))),
        "descents": whole(),
        "forgotten": whole(),
    }

    def __init__(self) -> None:
        self.all: list[Optimum] = []
        self.forgotten = 0
        self._descents = 0  # new ones since the best optimum was found

    def note(self, found: TrainingSample, distance: Distance, *, began_apart: bool = True) -> bool:
        """Note where a search ended; returns whether that is the best optimum so far.

        distance: of two points (d,), in units of the unit cube.
        began_apart: whether the search had begun apart from there.
        """
        best = not self.all or found.loss < self.all[0].sample.loss
        if best:
            self._descents = 0
        close = [o for o in self.all if distance(o.sample.x, found.x) < APART]
        searches = int(began_apart) + sum(optimum.searches for optimum in close)
        if close and close[0].sample.loss <= found.loss:
            close[0].searches += int(began_apart)
            return False
        self.all = [optimum for optimum in self.all if optimum not in close]
        self.all.append(Optimum(found, searches=searches))
        self.all.sort(key=lambda optimum: optimum.sample.loss)
        self.forgotten += sum(optimum.searches for optimum in self.all[_MOST:])
        del self.all[_MOST:]
        return best

    def others(self, distance: Distance) -> tuple[float | None, float]:
        """How far the answers of searches differ that ended in other places than the best.

        Their lowest loss, None without any, and the largest distance of one from the best place.
        Those count that had begun apart from where they ended.
        """
        found = [optimum.sample for optimum in self.all[1:] if optimum.searches]
        if not found:
            return None, 0.0
        best = self.all[0].sample.x
        return found[0].loss, max(distance(best, one.x) for one in found)

    def of(self, sample: TrainingSample) -> Optimum | None:
        """Return the optimum with this sample, if it is remembered."""
        return next((optimum for optimum in self.all if optimum.sample is sample), None)

    def fail(self, incumbent: TrainingSample) -> None:
        """Note that a move from this optimum failed."""
        optimum = self.of(incumbent)
        if optimum is not None:
            optimum.failures += 1

    def next(self, tolerance: float) -> TrainingSample | None:
        """Return the optimum that is tried next; None: it is time for a new search.

        tolerance: failures that outweigh one rank.
        """
        scores = [rank + one.failures / tolerance for rank, one in enumerate(self.all)]
        if not scores or min(scores) >= _NEW + _NEW_AGAIN * self._descents:
            self._descents += 1
            return None
        return self.all[int(np.argmin(scores))].sample

    def state_dict(self) -> dict[str, Any]:
        """Everything."""
        return {
            "samples": [one.sample.state_dict() for one in self.all],
            "counts": [[one.failures, one.searches, int(one.refined)] for one in self.all],
            "descents": self._descents,
            "forgotten": self.forgotten,
        }

    def load_state_dict(
        self, state: Mapping[str, Any], sides: Sides | None = None, device: device | None = None
    ) -> None:
        """Put back what `state_dict` gave, tokens on the device; ValueError if it is none."""
        check(state, self.SCHEMA, dict(sides or {}), "optima")
        samples = [TrainingSample.from_state(one, device) for one in state["samples"]]
        pairs = zip(samples, state["counts"], strict=True)
        self.all = [Optimum(one, n, m, bool(refined)) for one, (n, m, refined) in pairs]
        self._descents, self.forgotten = state["descents"], state["forgotten"]
